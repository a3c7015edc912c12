"""The whole state of training, saved in shards and resharded on resume.

``learner.pt`` (main rank): weights, optimizer, normalisers, learning rate, progress. ``rank-<k>.pt`` (each rank): every tensor of
its worlds, and its generators. Worlds have global indices, so they can be resharded to any number of ranks.
Files are written with ``torch.save`` and only ever read with ``weights_only=True``: loading runs no code.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple

from shared_store.contract.error_text import counted
from shared_store.contract.policy_changes import brief, differences
from shared_store.volume.checkpoints import (
    Checkpoint,
    DamagedCheckpoint,
    NewerFormat,
    newest_checkpoint,
    set_aside,
    sweep,
)
from shared_store.volume.epoch import check_epoch
from shared_store.volume.run_settings import changed_setting, changed_task, setting_at
from worker.learning.algorithm import Algorithm, WorldShare
from worker.learning.algorithms import section_of
from worker.learning.distributed import Gang
from worker.learning.job import Job
from worker.learning.randomness import generator_state, restore_generators
from worker.learning.saving import Saver
from worker.learning.setup import check_robots, contract_from
from worker.learning.shards import Shards, read_file
from worker.learning.trained import chosen_by_main
from worker.settings.errors import UserError
from worker.tasks.run.adapting import adaptive_steps

if TYPE_CHECKING:
    from worker.learning.reporter import Gate, Reporter
    from worker.tasks.run.task import Task


class EndedEpisodes(NamedTuple):
    """Episodes that ended in one iteration, over all ranks."""

    steps: float
    """Control steps of each world."""
    episodes: float
    """Number of episodes that ended."""
    returns: float
    """The sum of their returns."""
    squares: float = math.nan
    """The sum of the squares of their returns; unknown in older checkpoints."""


class _Copies(NamedTuple):
    """The state that was copied for a save that may be ordered after the next iteration began."""

    iteration: int = -1
    """Iterations done."""
    parts: dict[str, Any] = {}
    """The copies of the state after them."""
    adaptive_steps: dict[str, float] = {}
    """The step of each adaptive number in the last of them: the next iteration moves it when it begins."""


@dataclass
class Progress:
    """Progress of training."""

    iteration: int = 0
    """Iterations done."""
    env_steps: int = 0
    """Total steps over all worlds."""
    reward: float | None = None
    """Mean return of the episodes that ended in the last iteration in which any ended; None before the first."""
    episode_length: float | None = None
    """Their mean length [steps]."""
    score: float | None = None
    """Mean return of the newest episodes, over enough of them to compare checkpoints; None until there are enough."""
    score_error: float | None = None
    """Standard error of the score: the standard deviation of these episodes' returns over the square root of their number."""
    score_episodes: int = 0
    """Number of episodes in the score."""
    recent: list[list[float]] = field(default_factory=list)
    """The newest iterations, as many as the score needs: the fields of :class:`EndedEpisodes`, as lists for checkpoints."""

    def saved(self) -> dict[str, Any]:
        """All fields, for a thread that writes them while training continues: the entries of ``recent`` never change, only the list
        does."""
        return {**vars(self), "recent": list(self.recent)}

    def count(self, ended_now: EndedEpisodes, *, worlds: int, longest: int) -> None:
        """Record the episodes that ended in an iteration, and update the score and its error.

        The score covers at least :data:`EPISODES` episodes, one for each of the ``worlds`` of all ranks, and at least as many steps as the
        ``longest`` episode. With fewer, only early ends would count, which are falls.
        """
        self.recent.append(list(ended_now))
        span = ended = total = spread = 0.0
        for index in reversed(range(len(self.recent))):
            entry = EndedEpisodes(*self.recent[index])
            span, ended = span + entry.steps, ended + entry.episodes
            total, spread = total + entry.returns, spread + entry.squares
            if span >= longest and ended >= max(EPISODES, worlds):
                self.score, self.score_episodes = total / ended, int(ended)
                variance = max(0.0, spread - total * total / ended) / (ended - 1) if math.isfinite(spread) else None
                self.score_error = None if variance is None else math.sqrt(variance / ended)
                del self.recent[:index]
                return


EPISODES = 100
"""Least number of episodes in a score."""


class TrainingState:
    """The saved and restored state: the learner, this rank's worlds, the progress."""

    def __init__(
        self,
        job: Job,
        gang: Gang,
        share: WorldShare,
        task: Task,
        algorithm: Algorithm,
        facts: dict[str, Any],
        keep: int,
        gate: Gate | None = None,
    ) -> None:
        """``facts``: extra manifest fields (task, configuration), so that a checkpoint can be read on its own. Saving waits at ``gate``."""
        self.job, self.gang, self.share = job, gang, share
        self.task, self.algorithm, self.facts = task, algorithm, facts
        self.progress = Progress()
        self.seconds = 0.0
        """Time spent in iterations by all attempts [s]; kept in the manifest, since no two runs take the same time."""
        self.saver = Saver(job.run, job.epoch, gang.rank, gang.size, keep, gate)
        self._copied = _Copies()
        self.ordered_at: int | None = None
        """Iteration of the newest save that was ordered, or of the checkpoint that was loaded."""
        self.load_seconds = 0.0
        """Time to read and load the checkpoint [s], without checking its digests."""
        self.learning_rate: float | None = None
        """The learning rate after the newest iteration, or the first one of a resumed run; kept in the manifest."""
        self.set_anew: Sequence[str] = ()
        """One log line for each value that this job's settings replace in the checkpoint."""

    def copy(self, iteration: int) -> None:
        """Copy the state for a save after ``iteration``.

        Called before the host waits for the iteration's numbers, it costs the host no time: the device copies when it gets there.
        """
        own = {_OF_ALGORITHM + name: tensor for name, tensor in self.algorithm.world_state().items()}
        worlds = {"first": self.share.first, "count": self.share.count}
        parts = {
            "worlds": {**worlds, "state": {**self.task.state_tensors(), **own}},
            "generators": generator_state(),
            "algorithm": self.algorithm.state_dict() if self.gang.is_main else {},
        }
        self._copied = _Copies(iteration, self.saver.copy(parts), adaptive_steps(self.task))

    @property
    def is_copied(self) -> bool:
        """Whether the present state has been copied already."""
        return self._copied.iteration == self.progress.iteration

    def save(self, reporter: Reporter | None = None, *, wait: bool = True, scheduled: bool = True) -> None:
        """Order a checkpoint of the present state; every rank calls it. Stops only for the copy to host memory.

        Args:
            reporter: The checkpoint is committed after the calls that ``reporter`` has so far: a run that goes on from it has the
                metrics records before it.
            wait: For earlier saves that are still being written, as long as they take.
            scheduled: Whether a checkpoint is due at this iteration by the job's settings or by request.

        Raises:
            StaleEpoch: A newer attempt owns the run.
        """
        iteration = self.progress.iteration
        if not self.is_copied:
            self.copy(iteration)
        copied, adaptive = self._copied.parts, self._copied.adaptive_steps
        self._copied = _Copies()
        files = {f"rank-{self.gang.rank}.pt": {name: copied[name] for name in ("worlds", "generators")}}
        if self.gang.is_main:
            files["learner.pt"] = {"algorithm": copied["algorithm"], "progress": self.progress.saved()}
        if reporter:
            reporter.do(self.saver.note_records, iteration)
        facts = {**self._manifest(), "adaptive_steps": adaptive, "scheduled": scheduled} if self.gang.is_main else None
        self.saver.save(iteration, files, facts, after_records=reporter is not None, wait=wait)
        self.ordered_at = iteration

    def finish(self) -> list[str]:
        """Wait until every save is durable or has failed; every rank calls it. Returns lines for the log. Raises StaleEpoch if a newer
        attempt owns the run.
        """
        lines = [] if self.gang.is_main else self.saver.wait()
        if self.gang.greatest(self.saver.failures):
            self.saver.abandon()
        return lines + self.saver.wait()

    @property
    def saved_at(self) -> str | None:
        """Name of the newest durable checkpoint that this attempt started from or made (main rank)."""
        return self.saver.committed

    def _manifest(self) -> dict[str, Any]:
        shares = [WorldShare.of(rank, self.gang.size, self.share.total) for rank in range(self.gang.size)]
        return {
            **self.facts,
            "world_size": self.gang.size,
            "worlds": self.share.total,
            "shards": [[share.first, share.count] for share in shares],
            **{name: getattr(self.progress, name) for name in _IN_MANIFEST},
            "learning_rate": self.learning_rate,
            "seconds": self.seconds,
        }

    def restore(self) -> Checkpoint | None:
        """Resume from the newest good checkpoint, or from the chosen one; None without any. All ranks call it.

        The main rank chooses and verifies; damaged checkpoints are reported and set aside.

        Raises:
            UserError: The checkpoint does not fit this job; the message names the difference.
            DamagedCheckpoint: The chosen one can't be used, or the newest one has a newer format.
        """
        checkpoint, problem = chosen_by_main(self.gang, self.job.run.checkpoints, self._choose, (DamagedCheckpoint,))
        if problem:
            raise DamagedCheckpoint(problem)
        if checkpoint:
            self.load(checkpoint)
        return checkpoint

    def _choose(self) -> Checkpoint | None:
        def damaged(checkpoint: Checkpoint, error: DamagedCheckpoint) -> None:
            if isinstance(error, NewerFormat):  # the run's history continues in a format that this version can't read
                raise error
            place = set_aside(checkpoint)
            print(f"warning: {error}; it was set aside as {place.name} and the one before it is used", flush=True)

        job = self.job
        check_epoch(job.run, job.epoch)  # a rank that was frozen until now must not delete its successor's work
        sweep(job.run)
        return newest_checkpoint(job.run, chosen=job.checkpoint, chosen_since=job.job_epoch, damaged=damaged)

    def load(self, checkpoint: Checkpoint) -> None:
        """Load the state of ``checkpoint``. Raises UserError if it does not fit."""
        started = time.perf_counter()
        self._check_fit(checkpoint)
        learner = read_file(checkpoint, "learner.pt", self.gang.device)
        try:
            self.set_anew = self.algorithm.load_state_dict(learner["algorithm"], changed=self._changed(checkpoint))
            self.progress = Progress(**learner["progress"])
        except (RuntimeError, ValueError, KeyError, TypeError) as error:
            raise UserError(
                f"checkpoint {checkpoint.name} does not fit this job's task and algorithm: {error}"
            ) from error
        self.learning_rate = checkpoint.manifest.get("learning_rate")
        self.seconds = float(checkpoint.manifest.get("seconds", 0.0))
        self._load_worlds(checkpoint)
        self.saver.committed, self.ordered_at = checkpoint.name, checkpoint.iteration
        self.load_seconds = time.perf_counter() - started

    def _changed(self, checkpoint: Checkpoint) -> set[str]:
        """The algorithm's settings that differ from those of ``checkpoint``, or that this job sets and that one did not."""
        saved, here = (json.loads(json.dumps(facts)) for facts in (checkpoint.manifest, self.facts))
        keys = f"train.{section_of(here['algorithm'])}", "settings"
        pairs = [(setting_at(saved, key) or {}, setting_at(here, key) or {}) for key in keys]
        return {name for old, new in pairs for name in new if old.get(name) != new[name]}

    def _check_fit(self, checkpoint: Checkpoint) -> None:
        """Compare the manifest with this job, before any tensor is loaded. Raises UserError with the first difference."""
        saved, here = checkpoint.manifest, json.loads(json.dumps(self.facts))
        if "algorithm" not in saved:
            raise UserError(
                f"checkpoint {checkpoint.name} is of an older Muster, which knew no algorithms; start a new run"
            )
        trains = [{**facts["train"], "task": facts["task"], "algorithm": facts["algorithm"]} for facts in (saved, here)]
        changed = changed_setting(self.algorithm.config_type, saved["settings"], here["settings"], saved["settings"])
        if difference := changed_task(self.task.config, *trains) or changed:
            key, old, new, *of_algorithm = difference
            if of_algorithm:
                key = f"{section_of(saved['algorithm'])}.{key}"
            elif key not in ("task", "algorithm"):
                key = f"train.{key}"
            raise UserError(
                f"checkpoint {checkpoint.name} does not fit this job's task and algorithm: {key} is {old!r} there and {new!r} "
                "here; start a new run for that (`muster clone` begins one with its weights)"
            )
        then, now = (contract_from(facts, checkpoint.name) for facts in (saved, here))
        accept = bool(self.job.section.get("accept_changed_robot"))
        changes = check_robots(then, self.task, f"checkpoint {checkpoint.name}", accept=accept)
        if self.gang.is_main:
            if changes:
                print(f"warning: {changes}", flush=True)
            if then and now and (lines := differences(then, now, ranges=True)):
                print(f"warning: the task changed since checkpoint {checkpoint.name}: {brief(lines)}", flush=True)

    def _load_worlds(self, checkpoint: Checkpoint) -> None:
        total, bounds = checkpoint.manifest["worlds"], checkpoint.manifest["shards"]
        if total != self.share.total:
            raise UserError(
                f"checkpoint {checkpoint.name} holds {counted(total, 'world')} ({counted(len(bounds), 'rank')} of {bounds[0][1]}), this job has "
                f"{self.share.total} ({counted(self.gang.size, 'rank')} of {self.share.count}): set `worlds` and `nodes` so that their product "
                f"is {total}"
            )
        shards = Shards(checkpoint)
        try:
            state = shards.worlds(self.share.first, self.share.count)
            own = {name: state.pop(name) for name in list(state) if name.startswith(_OF_ALGORITHM)}
            self.task.load_state_dict(state)
            self.algorithm.load_world_state({name.removeprefix(_OF_ALGORITHM): own[name] for name in own})
            if len(bounds) == self.gang.size:  # after resharding, a rank's own generators have no counterpart
                restore_generators(shards.rank(self.gang.rank)["generators"])
        except (ValueError, KeyError, TypeError) as error:
            raise UserError(f"checkpoint {checkpoint.name}: {error}") from error


_IN_MANIFEST = ("reward", "score", "score_error", "score_episodes", "episode_length", "env_steps")
"""Fields of :class:`Progress` that a manifest has."""
_OF_ALGORITHM = "algorithm/"
"""Prefix of the names of an algorithm's per-world state."""
