"""The training loop: collect, learn, log, checkpoint, exit on request."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from shared_store.contract.error_text import counted
from shared_store.contract.phases import Phase
from shared_store.volume.checkpoints import Checkpoint
from shared_store.volume.node_outcomes import EX_TEMPFAIL
from worker.learning.algorithm import WorldShare
from worker.learning.algorithms import check_actions, check_metrics, check_names, check_state
from worker.learning.cuda_graph import CudaGraphFunction
from worker.learning.distributed import Gang
from worker.learning.exchange import SIGNALS, Exchange
from worker.learning.hooks import FaultInjection, Hook
from worker.learning.incident import Incident
from worker.learning.job import StopRequest, end_startup, user_errors
from worker.learning.leaving import complete, patience_of
from worker.learning.loaded_weights import adopt, load_teacher
from worker.learning.randomness import seed_generators
from worker.learning.report import Failures, Reporting, Stopwatch, figures_of, shown_of, straggler
from worker.learning.reporter import Beacon, Fence, Gate, Reporter
from worker.learning.saving import Cadence
from worker.learning.setup import (
    build_algorithm,
    build_task,
    describe,
    described_policy,
    total_worlds,
    transition,
    write_contract,
)
from worker.learning.state import EndedEpisodes, TrainingState
from worker.learning.training import Training, as_started
from worker.settings.errors import TrainingError, UserError
from worker.settings.task import value_at

if TYPE_CHECKING:
    from worker.tasks.run.step_log import StepLog

WARNINGS = 10
"""Resets of worlds are logged for at most this many iterations; later ones are only counted."""
EPISODES = ("episodes", "episode_return", "episode_length", "squared_return")
"""The task's statistics that become reward, episode length and score; the others are reported by their names."""


class Loop:
    """Trains one task on the worlds of one rank, in step with the other ranks."""

    def __init__(self, training: Training, gang: Gang, stop: StopRequest, hooks: Sequence[Hook] = ()) -> None:
        """Build worlds and learner, and resume from the run's newest checkpoint, if any. All ranks call it.

        Raises UserError for settings that the task refuses, and for a checkpoint that does not fit.
        """
        training, self._earlier_settings = as_started(training, gang)
        job = training.job
        self.training, self.job, self.config, self.gang, self.stop = training, job, training.config, gang, stop
        own = [FaultInjection(os.environ, job)] if gang.is_main else []
        self._hooks: Sequence[Hook] = [*own, Reporting(self), *hooks]
        self.share = WorldShare.of(gang.rank, gang.size, total_worlds(job, gang))
        self.cadence = Cadence(training.save_every)
        self._save_is_due = self._order_is_due = self._is_scheduled = False
        self._longest = patience_of(os.environ) / 2
        """Duration of an iteration [s] above which each one is saved: a stop may have to leave in the middle of the next one."""
        self.exits = False
        """Whether a request to exit is being carried out."""
        self.beacon = Beacon()
        seed_generators(training.seed)  # the learner's weights are drawn alike on all ranks
        self.task = build_task(training.task_type, self.config, self.share, gang, training.seed, self.beacon)
        kind, settings = training.algorithm_type, training.settings
        self.algorithm = build_algorithm(kind, settings, self.task, self.share, gang, training.seed)
        check_state(self.algorithm, training.algorithm)
        self._step = transition(self.task)
        self.incident = Incident(self.task, self.share, self.algorithm.steps, job.section, training.seed)
        seed_generators(training.seed, gang.rank)
        facts = describe(training, self.task, described_policy(training, self.task))
        self.gate = Gate()
        self.state = TrainingState(job, gang, self.share, self.task, self.algorithm, facts, training.keep, self.gate)
        self.resumed = self.state.restore()
        self.adopted = None if self.resumed else self._begin_run(facts)
        """Checkpoint with a clone's initial weights; None for a run that began with new ones, or has a checkpoint of its own."""
        self.step_log: StepLog | None = None
        if gang.is_main:
            write_contract(job, facts["contract"])
            try:
                with user_errors():  # for a link in its place
                    done = self.state.progress.iteration
                    self.step_log = self.task.step_log(job.run, self.algorithm.steps, done, facts)
            except OSError as error:
                raise TrainingError(f"{error.filename or job.run.path}: {error.strerror or error}") from None
        self.task.clear_statistics()
        self.iterated = 0
        """Iterations that this process has done."""
        self._warnings = 0
        self._stopwatch = Stopwatch(gang.device)
        self._stall_seconds = 0.0
        captures = self.algorithm.captures_rollout and not self.task.waits_for_host
        self._collecting = CudaGraphFunction(self._collect, gang.device if captures else "cpu", "rollout")
        self._exchange = Exchange(gang, self.task)
        self.reporter, self.fence = Reporter(self.gate), Fence(job.run, job.epoch)
        self.failures = Failures(self.task, lambda line: self.reporter.do(_print, line))
        self.state.saver.start()
        end_startup()

    def _begin_run(self, facts: dict[str, Any]) -> Checkpoint | None:
        """Start a run for the first time; returns a clone's checkpoint with the initial weights."""
        adopted = adopt(self.job, self.gang, self.algorithm, facts)
        load_teacher(self.job, self.gang, self.algorithm, adopted)
        self.task.set_random_episode_length()
        return adopted

    def train(self) -> int:
        """Train to the end; returns the exit code: 0 done, 75 exited on request with a checkpoint.

        Raises TrainingError for a non-finite loss; the last checkpoint remains valid.
        """
        progress = self.state.progress
        self.say("\n".join(filter(None, [*self.task.notes(), self._beginning(), self._earlier_settings])))
        self._stopwatch.begin()
        self.beacon.enter(Phase.TRAINING)
        try:
            for hook in self._hooks:
                hook.begin(self)
            while progress.iteration < self.training.iterations:
                if any([hook.before_iteration() for hook in self._hooks]):  # each is called
                    self._collecting.release()
                record, signals = self._iterate()
                for hook in self._hooks:
                    hook.iteration(record)
                if self._handle(signals):
                    self.say(f"stop requested: left after iteration {progress.iteration} of {self.training.iterations}")
                    return EX_TEMPFAIL
            checkpoint = complete(self)
            self.failures.report(again=True)
            for hook in self._hooks:
                hook.trained(self, checkpoint)
            return 0
        finally:
            for hook in self._hooks:
                hook.close()

    @property
    def graphs(self) -> list[CudaGraphFunction]:
        """The parts of an iteration that run as CUDA graphs."""
        return [self._collecting, *self.algorithm.graphs]

    def close(self) -> None:
        """Leave the gang and end the saver; the loop can't train afterwards."""
        self.state.saver.close()
        for part in self.graphs:
            part.release()
        self.gang.close()

    def _handle(self, signals: dict[str, float]) -> bool:
        """Save when a save is due, and log the results of earlier saves; returns whether the gang exits (then everything is saved)."""
        state, iteration = self.state, self.state.progress.iteration
        self.exits = stopping = signals["stopping"] > 0
        if signals["failed_saves"] > 0:
            state.saver.abandon()
        is_last = stopping or iteration == self.training.iterations
        scheduled = self.cadence.due(iteration, signals) or signals["save_now"] > 0 or is_last
        self._is_scheduled = self._is_scheduled or scheduled
        self._save_is_due = self._save_is_due or scheduled or signals["long"] > 0
        # While the volume hangs, a save is postponed and training continues. All ranks decide alike.
        if is_last or (self._save_is_due and not signals["busy"]):
            self._save_is_due = False
            # order a save that no longer needs the device after the device has its next work
            self._order_is_due = self._collecting.can_be_captured and state.is_copied and not is_last
            if not self._order_is_due:
                self._order(wait=is_last)
        self.report_saves(state.saver.poll())
        if stopping:
            self.report_saves(state.finish())
        return stopping

    def _order(self, *, wait: bool = False) -> None:
        """Order a checkpoint of the state after the last whole iteration."""
        scheduled, self._order_is_due, self._is_scheduled = self._is_scheduled, False, False
        if self.step_log:  # before the checkpoint that needs it
            self.reporter.do(self.fence.guard, self.step_log.keep, self.state.progress.iteration)
        self.state.save(self.reporter if self.gang.is_main else None, wait=wait, scheduled=scheduled)
        self._stall_seconds = self.state.saver.stall

    def _beginning(self) -> str:
        worlds = f"{counted(self.share.total, 'world')} on {counted(self.gang.size, 'rank')}"
        if self.adopted:
            parent = (self.job.run.description() or {}).get("parent") or {}
            of = f"{parent.get('run')}@{self.adopted.iteration} (checkpoint {self.adopted.name})"
            return f"starting from the weights of {of}: {worlds}"
        if self.resumed is None:
            return f"starting from new weights: {worlds}"
        loaded = f"{self.resumed.size / 1e6:.2f} MB in {self.state.load_seconds:.3f} s"
        changes = "".join(f"; {line}" for line in self.state.set_anew)
        resumed = f"resumed from checkpoint {self.resumed.name}: {worlds} ({loaded}){changes}"
        return "\n".join(filter(None, [resumed, self.task.begins_anew()]))

    def report_saves(self, lines: list[str]) -> None:
        """Log the results of saves."""
        for line in filter(None, lines):
            self.reporter.do(_print, line)
            self.beacon.send(message=line)

    def _iterate(self) -> tuple[dict[str, Any], dict[str, float]]:
        """One iteration; its numbers (all ranks together), and the sums of :data:`SIGNALS` over the ranks."""
        progress, algorithm = self.state.progress, self.algorithm
        self._stopwatch.start()
        algorithm.begin(progress.iteration)
        self._begin_iteration(progress.iteration)
        if self.step_log:
            self.step_log.begin()
        self._collecting()
        if self.step_log:
            self.step_log.copy()
        self._stopwatch.mark()
        self._exchange.gather(self._stopwatch.collect, self._signals())
        metrics = algorithm.learn(self._step.observations)
        if self.iterated == 0:
            check_metrics(metrics, self.training.algorithm)
        self._stopwatch.mark()
        self.gate.open()
        if self._order_is_due:
            self._order()
        if self.cadence.expects(progress.iteration + 1) or progress.iteration + 1 == self.training.iterations:
            self.state.copy(progress.iteration + 1)
        # the one transfer of the iteration: from here on the host knows
        learnt, totals = self._exchange.read(metrics)
        if self.step_log:
            self.reporter.do(self.fence.guard, self.step_log.write, progress.iteration, self.step_log.taken())
        if self._collecting.can_be_captured:
            self.gate.shut()
        signals = dict(zip(SIGNALS, totals["signals"], strict=True))
        progress.iteration += 1
        self.state.learning_rate = learnt.get("learning_rate")
        self.iterated += 1
        if not all(map(math.isfinite, learnt.values())):
            worst = ", ".join(f"{name} {value:g}" for name, value in learnt.items())
            raise self._failure(f"the loss is not finite ({worst})", "Try a smaller learning_rate")
        record = self._count(totals["statistics"])
        if self.iterated == 1:
            check_names(learnt, record, self.training.algorithm)
        if record.get("nan_worlds"):
            self._judge_resets(int(record["nan_worlds"]), totals["failed_world"])
        return record | learnt | straggler(totals["collected"]), signals

    def _failure(self, what: str, hint: str, cause: str = "") -> TrainingError:
        """Build the error that ends training, for an unlike reason with an unlike ``cause``. Every rank must call it."""
        self.report_saves(self.state.finish())
        last = f"checkpoint {self.state.saved_at} stands" if self.state.saved_at else "there is no checkpoint yet"
        return TrainingError(f"iteration {self.state.progress.iteration}: {what}; {last}. {hint}", cause)

    def _judge_resets(self, resets: int, failed_worlds: list[float]) -> None:
        """Log worlds that were reset because of a non-finite value or failed physics. Raises TrainingError if they are too many,
        and UserError where another attempt would not do better."""
        total, iteration = self.share.total, self.state.progress.iteration
        found = [self.task.read_failed_world(int(code)) for code in failed_worlds]
        rank, (world, cause) = next((rank, failed_world) for rank, failed_world in enumerate(found) if failed_world)
        world += WorldShare.of(rank, self.gang.size, total).first
        what = f"{counted(resets, 'reset')} of worlds, among them world {world}: {cause}"
        if resets <= math.ceil(self.config.nan_limit * total):
            self._warnings += 1
            if self._warnings <= WARNINGS:
                what += "; from now on only counted" if self._warnings == WARNINGS else ""
                self.say(f"warning: iteration {iteration}: {what}")
                self.failures.report()
            return
        self.failures.report()
        files = [self.job.run.incidents / f"{iteration:08d}-rank-{number}.pt" for number in range(self.gang.size)]
        problem = ""
        if found[self.gang.rank]:
            try:
                self.incident.write(files[self.gang.rank], iteration)
            except OSError as error:
                problem = f" (it could not be written: {error.strerror})"
        self.gang.greatest(0)  # no rank ends the gang before every rank has written
        device = "" if self.gang.device == "cpu" else " --device cuda:0"
        failure = self._failure(
            f"{what}; that is more than nan_limit, {self.config.nan_limit:g} times {total} worlds",
            f"See it happen again: python -m worker.repeat_incident {files[rank]}{device}{problem}",
            cause,
        )
        raise UserError(str(failure)) if self.task.is_users_fault(cause) else failure

    def _begin_iteration(self, iteration: int) -> None:
        """Tell the task which iteration begins, since its curriculum may depend on it, and what the other ranks have counted."""
        now = iteration, self.state.progress.reward, self.state.progress.episode_length
        own = self.task.own_counts() if self.gang.size > 1 else {}
        others = {name: self.gang.sum(counts.clone()) - counts for name, counts in own.items()}
        self.incident.begin(*now, others)
        self.task.take_counts(others)
        self.task.begin_iteration(*now)

    def _signals(self) -> dict[str, float]:
        """This rank's :data:`SIGNALS`."""
        saver, stop = self.state.saver, self.stop
        save_now, stop.save_requested = stop.save_requested, False
        failures, saver.failures = saver.failures, 0
        return {
            "stopping": stop.requested,
            "save_now": save_now,
            "failed_saves": failures,
            "busy": saver.is_busy,
            "stall": saver.stall,
            "iteration_seconds": self._stopwatch.iteration,
            "long": max(self._stopwatch.iteration, self._stopwatch.running) > self._longest,
        }

    def _collect(self) -> None:
        self.incident.keep()
        for step in range(self.algorithm.steps):
            actions = self.algorithm.act(self._step.observations)
            if self.iterated == 0:
                check_actions(actions, self.task.actions.shape, self.training.algorithm)
            self.incident.note(step, actions)
            self.task.step(actions)
            self.algorithm.record(self._step)

    def _count(self, totals: list[float]) -> dict[str, Any]:
        """Bring the progress up to date with the ``totals`` of all ranks; the iteration's record without the losses."""
        progress = self.state.progress
        self._stopwatch.read()
        seconds = self._stopwatch.iteration
        steps = self.share.total * self.algorithm.steps
        progress.env_steps += steps
        self.state.seconds += seconds
        stall, self._stall_seconds = self._stall_seconds, 0.0
        known = dict(zip(self.task.statistic_names, totals, strict=True))
        finished, returns, lengths, squares = map(known.pop, EPISODES)
        if finished:
            progress.reward, progress.episode_length = returns / finished, lengths / finished
        ended = EndedEpisodes(self.algorithm.steps, finished, returns, squares)
        progress.count(ended, worlds=self.share.total, longest=self.task.max_episode_length)
        figures = figures_of(known, finished, lengths, self.task.final_metrics)
        curricula = self.config.curriculum.items()
        shown = ("iteration", "env_steps", "reward", "episode_length", "score", "score_error")
        return {
            **{name: getattr(progress, name) for name in shown},
            "episodes": int(finished),
            "steps_per_second": steps / seconds,  # by the clock, over everything
            "collect_seconds": self._stopwatch.collect,
            "learn_seconds": self._stopwatch.learn,
            "iteration_seconds": seconds,
            "stall_seconds": stall,  # of the save before this iteration, 0 without one
            "total_seconds": self.state.seconds,
            **{f"curriculum_{name}": value_at(points, progress.iteration - 1) for name, points in curricula},
            **figures,
            **shown_of(figures, self.task.shown_metrics),
        }

    def say(self, text: str) -> None:
        """Log ``text`` on the main rank; does not wait."""
        if self.gang.is_main:
            self.reporter.do(_print, text)


def _print(text: str) -> None:
    print(text, flush=True)
