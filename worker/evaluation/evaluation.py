"""Deterministic evaluation: the mean action, whole episodes from a fresh reset, the worlds of all ranks; and what is kept of it."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import torch

from shared_store.volume.checkpoints import best_evaluated, list_checkpoints
from shared_store.volume.evaluations import (
    by_checkpoint,
    checkpoint_of,
    evaluation_name,
    in_one_line,
    kind_of,
    list_evaluations,
)
from shared_store.volume.files import write_json
from shared_store.volume.layout import Run
from shared_store.volume.paired_episodes import are_paired, paired, read_returns
from worker.evaluation.episodes import Episodes, play
from worker.evaluation.statistics import Sample, difference, share
from worker.evaluation.table import write_table
from worker.learning.algorithm import Policy
from worker.learning.distributed import Gang
from worker.learning.report import shown_of
from worker.tasks.compile.tables import as_json

if TYPE_CHECKING:
    from worker.tasks.run.task import Task

FORMAT = 1


@dataclass(frozen=True)
class EvaluatedEpisodes:
    """The episodes of all ranks, and what they are of.

    Attributes:
        checkpoint: Its name.
        task: Name of the task.
        episodes: What is known of each.
        max_length: The longest that an episode can be [steps].
        weights: Weight of each reward term.
        seed: Of the worlds.
        seconds: How long it took, by the clock [s].
        shown: Unit of each metric that the task wants to be seen, such as ``{"metric_progress": "%"}``.
        config: The task's whole configuration, as JSON.
    """

    checkpoint: str
    task: str
    played: Episodes
    max_length: int
    weights: Mapping[str, float]
    seed: int | None
    seconds: float
    shown: Mapping[str, str]
    config: str

    @property
    def episodes(self) -> int:
        """Number of episodes."""
        return len(self.played.rows)

    @property
    def mean_return(self) -> float:
        """Mean sum of the rewards."""
        return float(self.played.returns.mean())

    @property
    def mean_length(self) -> float:
        """Mean length [steps]."""
        return float(self.played.lengths.mean())

    def __str__(self) -> str:
        return f"evaluation: {in_one_line(self.summary())}"

    def summary(self) -> dict[str, Any]:
        """Everything but the episodes themselves, as JSON values; lengths in steps, intervals of 95 %."""
        played, count = self.played, self.episodes
        returns = Sample.of(played.returns)
        ends = Counter(played.ends)
        successes = played.successes
        return {
            "format": FORMAT,
            "checkpoint": self.checkpoint,
            "task": self.task,
            "episodes": count,
            "seed": self.seed,
            "mean_return": returns.mean,
            "std_return": returns.std,
            "min_return": float(played.returns.min()),
            "max_return": float(played.returns.max()),
            "mean_length": self.mean_length,
            "max_length": self.max_length,
            "full_length": float(played.time_outs.double().mean()),
            "return": returns.describe(),
            "length": Sample.of(played.lengths).describe(),
            "success": None if successes is None else share(int(successes.sum()), count),
            "success_is": played.success,
            "causes": {name: share(ends[name], count) for name in played.causes if ends[name]},
            "rewards": {
                name: {**self._described(f"reward_{name}"), "weight": self.weights.get(name)}
                for name in self._named("reward_")
            },
            "metrics": {name: self._described(f"metric_{name}") for name in self._named("metric_")},
            **shown_of({name: float(played.term(name).mean()) for name in self.shown}, self.shown),
            "seconds": self.seconds,
        }

    def write(
        self, run: Run, job: str = "", judged: Mapping[str, Judged] | None = None, **facts: Any
    ) -> dict[str, Any]:
        """Write the table, then the summary, which is also returned. Raises OSError.

        Args:
            run: The run that was evaluated.
            job: Id of the job that did nothing else; it names the files.
            judged: By the key of the job's section, what the episodes were by its rules; its files are written before the table.
            **facts: What else the summary says.
        """
        name = evaluation_name(self.checkpoint, job)
        summary: dict[str, Any] = {
            **self.summary(),
            **facts,
            "job": job or None,
            "table": f"{name}.parquet",
            "time": time.time(),
        }
        summary |= {key: each.summary() for key, each in (judged or {}).items()}
        earlier = [each for each in list_evaluations(run) if each["name"] != name and each.get("task") == self.task]
        earlier = [
            each for each in earlier if kind_of(each) == kind_of(summary) and _rewards(each) == _rewards(summary)
        ]
        if earlier:
            summary["compared"] = self._compared(run, _partner(earlier, summary), summary)
        summary = _finite(summary)
        further: dict[str, list[Any]] = {}
        for each in (judged or {}).values():
            each.write(run.evaluations / name)
            further |= each.columns()
        known = {"run": run.name, "checkpoint": self.checkpoint, "task": self.task, "config": self.config}
        write_table(run.evaluations / summary["table"], self.played, self.seed, known, further or None)
        write_json(run.evaluations / f"{name}.json", summary)
        return summary

    def _named(self, prefix: str) -> list[str]:
        return [name.removeprefix(prefix) for name in self.played.terms if name.startswith(prefix)]

    def _described(self, term: str) -> dict[str, float | None]:
        return Sample.of(self.played.term(term)).describe()

    def _compared(self, run: Run, old: Mapping[str, Any], new: Mapping[str, Any]) -> dict[str, Any]:
        """The differences to an earlier evaluation of the run: episode by episode where both played the same ones."""
        std = old.get("std_return")
        before = Sample(int(old["episodes"]), float(old["mean_return"]), float(std or 0.0))
        return {
            "name": old["name"],
            "checkpoint": checkpoint_of(old["name"]),
            "time": old["time"],
            "other_worlds": (old.get("config") or {}) != (new.get("config") or {}),
            "return": self._pairs(run, old, new) or difference(Sample.of(self.played.returns), before),
        }

    def _pairs(self, run: Run, old: Mapping[str, Any], new: Mapping[str, Any]) -> dict[str, Any] | None:
        if not are_paired(new, old):
            return None
        try:
            return paired(self.played.returns.tolist(), read_returns(run.evaluations / f"{old['name']}.parquet"))
        except (OSError, ValueError):  # its table is gone, or damaged
            return None


class Judged(Protocol):
    """What the episodes of a job were by the rules of its section."""

    def summary(self) -> dict[str, Any]:
        """As JSON values, for the evaluation's summary."""

    def columns(self) -> dict[str, list[Any]]:
        """Further columns of the evaluation's table, a value for each episode."""

    def write(self, folder: Path) -> None:
        """Write further files into the directory of the evaluation. Raises OSError."""


class Watcher(Protocol):
    """Looks on while the episodes of a job are played whose section has rules of its own, one in each world.

    ``task``: at the start of the episodes.
    """

    def __init__(self, task: Any) -> None: ...

    def note(self, running: torch.Tensor) -> None:
        """Called after each control step with the worlds whose episode had not ended before it, shape ``(worlds,)``, bool."""

    def result(self, played: Episodes, section: Mapping[str, Any], seed: int, facts: Mapping[str, Any]) -> Judged:
        """What the episodes were.

        Args:
            played: How each ended.
            section: Of the job.
            seed: Of the worlds.
            facts: The checkpoint's manifest.
        """


def evaluate(
    task: Task, policy: Policy, gang: Gang, *, checkpoint: str, episodes: int | None = None
) -> EvaluatedEpisodes:
    """Run at least ``episodes`` episodes, by default one a world; all ranks call it. The worlds are left as they were."""
    started = time.perf_counter()
    before = task.state_dict()
    worlds = int(gang.sum(torch.tensor(float(task.world_count), device=gang.device)))
    played = play([task] * (1 if episodes is None else math.ceil(episodes / worlds)), policy, gang)
    task.load_state_dict(before)
    task.clear_statistics()
    return result_of(task, played, checkpoint, None, started)


def result_of(task: Task, played: Episodes, checkpoint: str, seed: int | None, started: float) -> EvaluatedEpisodes:
    """The evaluation that these episodes make; ``started`` by ``time.perf_counter``."""
    return EvaluatedEpisodes(
        checkpoint=checkpoint,
        task=type(task).__name__,
        played=played,
        max_length=task.max_episode_length,
        weights=getattr(task.config, "rewards", {}),
        config=as_json(task.config),
        seed=seed,
        seconds=time.perf_counter() - started,
        shown=task.shown_metrics,
    )


def best_words(run: Run) -> str:
    """Which checkpoint is the best by evaluations, as it is told at the end of a training; nothing where there is none to compare it with."""
    try:
        evaluated, checkpoints = by_checkpoint(run), list_checkpoints(run)
    except OSError:
        return ""
    best = best_evaluated(checkpoints, evaluated)
    if best is None or len(evaluated) < 2:
        return ""
    mean = evaluated[best.name]["mean_return"]
    return (
        f"best of {len(evaluated)} checkpoints that are evaluated: {run.name}@{best.iteration}, mean return {mean:.2f}"
    )


def _partner(earlier: Sequence[dict[str, Any]], new: Mapping[str, Any]) -> dict[str, Any]:
    """The evaluation to compare with: the newest of another checkpoint in the same episodes, else the newest of all."""
    paired = [each for each in earlier if are_paired(new, each) and each["checkpoint"] != new["checkpoint"]]
    return (paired or earlier)[-1]


def _rewards(summary: Mapping[str, Any]) -> list[Any]:
    """What an evaluation rewarded: returns of other rewards can't be compared."""
    terms, changes = summary.get("rewards") or {}, summary.get("config") or {}
    own = {key: value for key, value in changes.items() if key.startswith("reward")}
    return [{name: term.get("weight") for name, term in terms.items()}, own]


def _finite(value: Any) -> Any:
    """JSON has no infinity: None in its place."""
    if isinstance(value, Mapping):
        return {key: _finite(each) for key, each in value.items()}
    return None if isinstance(value, float) and not math.isfinite(value) else value
