"""The training loop: collect, learn, log, checkpoint, leave when asked, evaluate at the end."""

from __future__ import annotations

import math
import os
import statistics
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from shared_store.checkpoints import Checkpoint
from shared_store.outcomes import EX_TEMPFAIL
from worker.distributed import Gang
from worker.errors import TrainingError
from worker.learning import algorithms
from worker.learning.adoption import adopt
from worker.learning.algorithm import Share
from worker.learning.beacon import Beacon
from worker.learning.cadence import Cadence
from worker.learning.cuda_graph import CudaGraphFunction, HostCopy
from worker.learning.evaluation import evaluate
from worker.learning.faults import die, kill_at
from worker.learning.incident import Incident
from worker.learning.job import Job, StopRequest, configure, end_startup, user_errors
from worker.learning.randomness import held_out_seed, seed_generators
from worker.learning.report import Report, Stopwatch
from worker.learning.reporter import Fence, Reporter
from worker.learning.setup import build_algorithm, build_task, describe, observed, total_worlds, transition
from worker.learning.state import TrainingState
from worker.learning.totals import Totals
from worker.learning.trained import choose_checkpoint, load_learner
from worker.tasks.config import value_at

if TYPE_CHECKING:
    from worker.tasks.task import Task


EVALUATED = 256
"""At most so many worlds of each rank are built to evaluate a policy: those of training still hold their memory."""
WARNINGS = 10
"""At most so many iterations with worlds that were reset have a line of their own."""
EPISODES = ("episodes", "episode_return", "episode_length", "squared_return")
"""Those of a task's statistics that become reward, episode length and score; the others are told by their names."""
SIGNALS = ("stopping", "save_now", "failed_saves", "stall", "iteration_seconds")
"""What the ranks tell each other once an iteration, besides the statistics: how many were asked to stop, how many to save now, how
many of their saves failed, how long the last save stopped them and how long the last iteration took [s]."""


class Loop:
    """Trains one task on the worlds of one rank, in step with the other ranks."""

    def __init__(self, job: Job, gang: Gang, task_type: type[Task], stop: StopRequest) -> None:
        """Build worlds and learner, and go on from the run's newest checkpoint where there is one. All ranks call it.

        Raises UserError for settings that the task refuses, and for a checkpoint that does not fit.
        """
        self.job, self.gang, self.stop = job, gang, stop
        self.iterations = job.setting("iterations", 100)
        self.seed = job.setting("seed", 0, least=0)
        self._kill_at = kill_at(os.environ, job) if gang.is_main else None
        checkpoints = job.spec.get("checkpoint") or {}
        self.cadence = Cadence(checkpoints.get("every", 25))
        self.config = configure(task_type, job.section)
        share = Share.of(gang.rank, gang.size, total_worlds(job, gang))
        seed_generators(self.seed)
        self.task = build_task(task_type, self.config, share, gang, self.seed)
        self.algorithm_name = job.section.get("algorithm", algorithms.DEFAULT)
        chosen = algorithms.find_algorithm(self.algorithm_name)
        settings = algorithms.settings(chosen, self.algorithm_name, self.config, job.section)
        self.share = share
        self.algorithm = build_algorithm(chosen, settings, self.task, share, gang, self.seed)
        self._observations = observed(self.task)
        self._step = transition(self.task, self._observations)
        self.incident = Incident(self.task, share, self.algorithm.steps, job.section, self.seed)
        seed_generators(self.seed, gang.rank)
        self.iterated = 0
        """Iterations that this process has done."""
        facts = describe(job, self.task, self.config, self.algorithm_name, settings)
        keep = int(checkpoints.get("keep", 5))
        self.state = TrainingState(job, gang, share, self.task, self.algorithm, facts, keep)
        self.resumed = self.state.restore()
        self.adopted: Checkpoint | None = None
        """Whose weights a clone begins with; None of a run that began with new ones, or has a checkpoint of its own."""
        if self.resumed is None:
            self.adopted = adopt(job, gang, self.algorithm, facts)
            self._load_teacher(getattr(settings, "teacher_checkpoint", None))
            self.task.set_random_episode_length()
        self.task.clear_statistics()
        self._stopwatch = Stopwatch(gang.device)
        captured = gang.device if self.algorithm.captures_rollout else "cpu"
        self._collecting = CudaGraphFunction(self._collect, captured, "rollout")
        self._numbers = HostCopy(gang.device)
        self._totals = Totals(
            {
                "collected": gang.size,  # [s], of each rank in the iteration before
                "mishap": gang.size,  # of each rank, see Task.read_mishap
                "statistics": len(self.task.statistic_names),
                **dict.fromkeys(SIGNALS, 1),
            },
            gang.device,
        )
        self._own = torch.zeros(1 + len(SIGNALS), dtype=torch.float64, pin_memory=gang.device != "cpu")
        self._read_at = time.perf_counter()
        self._told_captured = False
        self._warnings = 0
        self._iteration_seconds = self._collect_seconds = self._stall_seconds = 0.0
        self.reporter = Reporter()
        self.fence = Fence(job.run, job.epoch)
        self.beacon = Beacon()
        self.state.saver.start()
        end_startup()

    def _load_teacher(self, reference: str | None) -> None:
        """Give the algorithm its teacher, unless it has it already: a checkpoint holds the teacher that was named for it."""
        adopted = self.adopted.manifest.get("settings") or {} if self.adopted else {}
        if reference and adopted.get("teacher_checkpoint") != reference:
            with user_errors("train"):
                self.algorithm.load_teacher(self._weights_of(reference))  # type: ignore[attr-defined]

    def _weights_of(self, reference: str) -> dict[str, Any]:
        """What the algorithm of another run has learnt, ``RUN`` or ``RUN@ITERATION``. All ranks call it."""
        name, _, iteration = reference.partition("@")
        run = self.job.store.run(name)
        copy = self.job.run.teacher(name)  # made when the job was submitted, unless the teacher's run was yet to come
        held = self.gang.tell(copy.checkpoints.is_dir())
        checkpoint = choose_checkpoint(self.gang, copy if held else run, iteration or None)
        learnt: dict[str, Any] = load_learner(checkpoint, self.gang.device)["algorithm"]
        return learnt

    def train(self) -> int:
        """Train to the end; returns the exit code: 0 done, 75 left on request with a checkpoint.

        Raises TrainingError where a loss is not finite; the last checkpoint stands.
        """
        progress = self.state.progress
        report = Report(self.job, self.iterations, progress.iteration) if self.gang.is_main else None
        self._say(self._beginning())
        self._read_at = time.perf_counter()
        try:
            while progress.iteration < self.iterations:
                record, signals = self._iterate()
                if progress.iteration == self._kill_at:
                    die()
                self.fence.check()
                if report:
                    self.reporter.do(report.iteration, record)
                self._tell_captured()
                self.beacon.tell(iteration=progress.iteration, steps_per_second=record["steps_per_second"])
                if self._handle(signals):
                    self._say(f"asked to stop: left after iteration {progress.iteration} of {self.iterations}")
                    return EX_TEMPFAIL
            self._finish()
            return 0
        finally:
            if report:
                self.reporter.do(report.close)
            self.reporter.close()
            self.fence.close()

    def close(self) -> None:
        """Leave the gang; nothing can be trained afterwards."""
        for part in (self._collecting, *self.algorithm.graphs):
            part.release()
        self.gang.close()

    def _tell_captured(self) -> None:
        """Say once, when it has come to that, which parts of an iteration the device replays by itself."""
        parts = [self._collecting, *self.algorithm.graphs]
        if (
            not self._told_captured
            and all(part.captured or not part.can_be_captured for part in parts)
            and any(part.captured for part in parts)
        ):
            self._told_captured = True
            self._say(
                "captured as CUDA graphs: "
                + ", ".join(f"{part.name} ({part.seconds:.1f} s to record)" for part in parts if part.captured)
            )

    def _handle(self, signals: dict[str, float]) -> bool:
        """Save when it is time, tell of earlier saves; True where the gang is to leave (then everything is saved)."""
        state, iteration = self.state, self.state.progress.iteration
        stopping = signals["stopping"] > 0
        if signals["failed_saves"] > 0:
            state.saver.abandon()
        due = self.cadence.due(iteration, signals)
        if stopping or due or signals["save_now"] > 0 or iteration == self.iterations:
            self.reporter.flush()  # a run that goes on from this save has the records before it
            state.save()
            self._stall_seconds = state.saver.stall
        self._tell_saved(state.saver.poll())
        if stopping:
            self._tell_saved(state.finish())
        return stopping

    def _beginning(self) -> str:
        ranks = f"{self.gang.size} rank{'s' if self.gang.size != 1 else ''}"
        there = f"{self.share.total} worlds on {ranks}"
        if self.adopted:
            parent = (self.job.run.description() or {}).get("parent") or {}
            of = f"{parent.get('run')}@{self.adopted.iteration} (checkpoint {self.adopted.name})"
            return f"starting from the weights of {of}: {there}"
        if self.resumed is None:
            return f"starting from new weights: {there}"
        size = self.resumed.size / 1e6
        return (
            f"resumed from checkpoint {self.resumed.name}: {there} ({size:.2f} MB in {self.state.load_seconds:.3f} s)"
            + "".join(f"; {line}" for line in self.state.set_anew)
        )

    def _tell_saved(self, lines: list[str]) -> None:
        for line in filter(None, lines):
            self.reporter.do(_print, line)
            self.beacon.tell(said=line)

    def _iterate(self) -> tuple[dict[str, Any], dict[str, float]]:
        """One iteration; the numbers of it (all ranks together), and the sums of :data:`SIGNALS` over the ranks."""
        progress, algorithm = self.state.progress, self.algorithm
        self._stopwatch.start()
        algorithm.begin(progress.iteration)
        self._begin_iteration(progress.iteration)
        self._collecting()
        self._stopwatch.mark()
        self._gather()
        metrics = algorithm.learn(self._observations)
        self._stopwatch.mark()
        # the one transfer of the iteration: from here on the host knows
        numbers = torch.cat([torch.stack([value.double() for value in metrics.values()]), self._totals.values])
        known = self._numbers.read(numbers)
        learnt = dict(zip(metrics, known, strict=False))
        totals = Totals.named(self._totals.layout, known[len(metrics) :])
        signals = {name: totals[name][0] for name in SIGNALS}
        progress.iteration += 1
        self.state.learning_rate = learnt.get("learning_rate")
        self.iterated += 1
        if not all(map(math.isfinite, learnt.values())):
            worst = ", ".join(f"{name} {value:g}" for name, value in learnt.items())
            raise self._failure(f"the loss is not finite ({worst})", "Try a smaller learning_rate")
        record = self._count(totals["statistics"])
        if record.get("nan_worlds"):
            self._judge_resets(int(record["nan_worlds"]), totals["mishap"])
        return record | learnt | straggler(totals["collected"]), signals

    def _gather(self) -> None:
        """Add up over the ranks what happened in the rollout, and what each rank has to tell."""
        totals, rank = self._totals, self.gang.rank
        totals.values.zero_()
        totals["mishap"][rank].copy_(self.task.mishap[0])
        totals["statistics"].copy_(self.task.statistics)
        self.task.clear_statistics()
        self._own.copy_(torch.tensor([self._collect_seconds, *self._signals()], dtype=torch.float64))
        totals["collected"][rank].copy_(self._own[0], non_blocking=True)
        for place, name in enumerate(SIGNALS, start=1):
            totals[name].copy_(self._own[place : place + 1], non_blocking=True)
        self.gang.sum(totals.values)

    def _failure(self, what: str, hint: str) -> TrainingError:
        """The end of a training that can't go on. The figures are those of the gang: every rank is here."""
        self._tell_saved(self.state.finish())
        last = f"checkpoint {self.state.saved_at} stands" if self.state.saved_at else "there is no checkpoint yet"
        return TrainingError(f"iteration {self.state.progress.iteration}: {what}; {last}. {hint}")

    def _judge_resets(self, resets: int, mishaps: list[float]) -> None:
        """Tell of worlds that were reset since something was not finite or the physics failed; raises TrainingError where they are too many."""
        total, iteration = self.share.total, self.state.progress.iteration
        found = [self.task.read_mishap(int(code)) for code in mishaps]
        rank, (world, cause) = next((rank, mishap) for rank, mishap in enumerate(found) if mishap)
        first = f"world {Share.of(rank, self.gang.size, total).first + world}: {cause}"
        if resets <= math.ceil(self.config.nan_limit * total):
            self._warnings += 1
            if self._warnings <= WARNINGS:
                more = "; from now on only counted" if self._warnings == WARNINGS else ""
                self._say(f"warning: iteration {iteration}: {resets} resets of worlds, among them {first}{more}")
            return
        files = [self.job.run.incidents / f"{iteration:08d}-rank-{number}.pt" for number in range(self.gang.size)]
        problem = ""
        if found[self.gang.rank]:
            try:
                self.incident.write(files[self.gang.rank], iteration)
            except OSError as error:
                problem = f" (it could not be written: {error.strerror})"
        self.gang.greatest(0)  # nobody ends the gang before every rank has written
        where = "" if self.gang.device == "cpu" else " --device cuda:0"
        raise self._failure(
            f"{resets} resets of worlds, among them {first}; that is more than nan_limit, {self.config.nan_limit:g} times {total} worlds",
            f"See it happen again: python -m worker.repeat_incident {files[rank]}{where}{problem}",
        )

    def _begin_iteration(self, iteration: int) -> None:
        """Tell the task, whose curriculum may depend on it."""
        told = iteration, self.state.progress.reward, self.state.progress.episode_length
        self.incident.begin(*told)
        self.task.begin_iteration(*told)

    def _signals(self) -> tuple[float, ...]:
        """This rank's :data:`SIGNALS`."""
        saver, stop = self.state.saver, self.stop
        save_now, stop.save_requested = stop.save_requested, False
        failures, saver.failures = saver.failures, 0
        return float(stop.requested), float(save_now), float(failures), saver.stall, self._iteration_seconds

    def _collect(self) -> None:
        self.incident.keep()
        for step in range(self.algorithm.steps):
            actions = self.algorithm.act(self._observations)
            self.incident.note(step, actions)
            self.task.step(actions)
            self.algorithm.record(self._step)

    def _count(self, totals: list[float]) -> dict[str, Any]:
        """Bring the progress up to date with the ``totals`` of all ranks; the iteration's record without the losses."""
        progress = self.state.progress
        collect, learn = self._stopwatch.parts()
        now = time.perf_counter()
        took, self._read_at = now - self._read_at, now
        steps = self.share.total * self.algorithm.steps
        progress.env_steps += steps
        self.state.seconds += took
        self._iteration_seconds, self._collect_seconds = took, collect
        stall, self._stall_seconds = self._stall_seconds, 0.0
        known = dict(zip(self.task.statistic_names, totals, strict=True))
        finished, returns, lengths, squares = map(known.pop, EPISODES)
        if finished:
            progress.reward, progress.episode_length = returns / finished, lengths / finished
        progress.count(
            self.algorithm.steps,
            finished,
            returns,
            squares,
            worlds=self.share.total,
            longest=self.task.max_episode_length,
        )
        return {
            "iteration": progress.iteration,
            "env_steps": progress.env_steps,
            "reward": progress.reward,
            "episode_length": progress.episode_length,
            "score": progress.score,
            "score_error": progress.score_error,
            "episodes": int(finished),
            "steps_per_second": steps / took,  # by the clock, over everything
            "collect_seconds": collect,
            "learn_seconds": learn,
            "iteration_seconds": took,
            "stall_seconds": stall,  # of the save before this iteration, 0 where there was none
            "total_seconds": self.state.seconds,
            **{
                f"curriculum_{name}": value_at(points, progress.iteration - 1)
                for name, points in self.config.curriculum.items()
            },
            **{name: _figure(name, value, finished) for name, value in known.items()},
        }

    def _finish(self) -> None:
        """Wait for the last save, evaluate what was learnt, draw the curve, say where everything is."""
        if self.state.ordered_at != self.state.progress.iteration:
            self.state.save()
        self._tell_saved(self.state.finish())
        name = self.gang.tell(self.state.saved_at) or ""
        if not name.startswith(f"{self.state.progress.iteration:08d}-"):
            raise TrainingError(
                "training is done, but its last checkpoint could not be saved; free space in the store and start again"
            )
        self.beacon.tell(done=True)
        self._say(f"evaluating checkpoint {name}")
        result = evaluate(self.held_out_worlds(), self.algorithm.policy(), self.gang, checkpoint=name)
        self._say(str(result))
        if not self.gang.is_main:
            return
        try:
            result.write(self.job.run)
            from worker.plot import plot_reward

            plot: Path | None = plot_reward(self.job.run)
        except (OSError, ValueError) as error:
            self._say(f"warning: the evaluation or the plot could not be written ({error})")
            plot = None
        self._say(f"last checkpoint: {self.job.run.checkpoints / name}")
        if plot:
            self._say(f"reward plot: {plot}")

    def held_out_worlds(self) -> Task:
        """The worlds on which the policy is evaluated. All ranks call it.

        They are those of training, whose episodes each begin at a new random start, unless the worlds themselves were drawn at random:
        then they are others, drawn from another seed.
        """
        worlds, began = self.task, max(0, self.state.progress.iteration - 1)
        if self.config.randomize.draws_worlds:
            total = min(self.share.total, EVALUATED * self.gang.size)
            share = Share.of(self.gang.rank, self.gang.size, total)
            worlds = build_task(type(self.task), self.config, share, self.gang, held_out_seed(self.seed))
        worlds.begin_iteration(began, self.state.progress.reward, self.state.progress.episode_length)
        return worlds

    def _say(self, text: str) -> None:
        if self.gang.is_main:
            self.reporter.do(_print, text)


def _print(text: str) -> None:
    print(text, flush=True)


def straggler(seconds: list[float]) -> dict[str, float]:
    """Which rank collected the longest in the iteration before, and how much longer than the median: all others wait for it.

    Args:
        seconds: By rank; empty figures for a gang of one.
    """
    if len(seconds) == 1:
        return {}
    slowest = max(range(len(seconds)), key=seconds.__getitem__)
    usual = statistics.median(seconds)
    return {"slowest_rank": slowest, "slowest_excess": seconds[slowest] / usual - 1.0 if usual > 0 else 0.0}


def _figure(name: str, total: float, episodes: float) -> float | None:
    """A reward term is told as its mean over the finished episodes, a count of mishaps as it is."""
    if not name.startswith("reward_"):
        return total
    return total / episodes if episodes else None
