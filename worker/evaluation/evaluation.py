"""Deterministic evaluation: the best action, whole episodes from a fresh reset, the worlds of all ranks; its summary and its table."""

from __future__ import annotations

import contextlib
import io
import math
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
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
from shared_store.volume.files import write_atomic, write_json
from shared_store.volume.layout import Run
from shared_store.volume.paired_episodes import are_paired, paired, read_returns
from worker.evaluation.episodes import Episodes, play
from worker.evaluation.statistics import Sample, difference, share
from worker.learning.algorithm import Policy
from worker.learning.distributed import Gang
from worker.learning.report import shown_of
from worker.tasks.compile.tables import as_json

if TYPE_CHECKING:
    from worker.tasks.run.task import Task

FORMAT = 1


@dataclass(frozen=True)
class EvaluatedEpisodes:
    """The episodes of all ranks, with their checkpoint and task."""

    checkpoint: str
    """Its name."""
    task: str
    """Name of the task."""
    played: Episodes
    """The record of each episode."""
    max_length: int
    """The longest that an episode can be [steps]."""
    weights: Mapping[str, float]
    """Weight of each reward term."""
    seed: int | None
    """Seed of the worlds; None: those of a training."""
    seconds: float
    """Wall-clock duration [s]."""
    shown: Mapping[str, str]
    """Unit of each metric that the task shows, such as ``{"metric_progress": "%"}``."""
    config: str
    """The task's whole configuration, as JSON."""

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
        played, count, successes = self.played, self.episodes, self.played.successes
        returns, ends = Sample.of(played.returns), Counter(played.ends)

        def described(prefix: str) -> dict[str, dict[str, Any]]:
            terms = [term for term in played.terms if term.startswith(prefix)]
            return {term.removeprefix(prefix): Sample.of(played.term(term)).describe() for term in terms}

        rewards = described("reward_").items()
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
            "rewards": {name: {**term, "weight": self.weights.get(name)} for name, term in rewards},
            "metrics": described("metric_"),
            **shown_of({name: float(played.term(name).mean()) for name in self.shown}, self.shown),
            "seconds": self.seconds,
        }

    def write(
        self, run: Run, job: str = "", judged: Mapping[str, Judged] | None = None, **facts: Any
    ) -> dict[str, Any]:
        """Write the table, then the summary, which is also returned. Raises OSError.

        Args:
            run: The run that was evaluated.
            job: Id of the evaluation's own job; it names the files.
            judged: By the key of the job's section, the results by its rules; their files are written before the table.
            **facts: Further entries of the summary.
        """
        name, results = evaluation_name(self.checkpoint, job), judged or {}
        summary: dict[str, Any] = {
            **self.summary(),
            **facts,
            "job": job or None,
            "table": f"{name}.parquet",
            "time": time.time(),
            **{key: each.summary() for key, each in results.items()},
        }
        earlier = [
            each
            for each in list_evaluations(run)
            if each["name"] != name and each.get("task") == self.task and kind_of(each) == kind_of(summary)
        ]
        if earlier := [each for each in earlier if _rewards(each) == _rewards(summary)]:
            # the newest of another checkpoint in the same episodes, else the newest of all
            other = [each for each in earlier if each["checkpoint"] != summary["checkpoint"]]
            partner = ([each for each in other if are_paired(summary, each)] or earlier)[-1]
            summary["compared"] = self._compared(run, partner, summary)
        summary = _finite(summary)
        further: dict[str, list[Any]] = {}
        for each in results.values():
            each.write(run.evaluations / name)
            further |= each.columns()
        known = {"run": run.name, "checkpoint": self.checkpoint, "task": self.task, "config": self.config}
        write_table(run.evaluations / summary["table"], self.played, self.seed, known, further or None)
        write_json(run.evaluations / f"{name}.json", summary)
        return summary

    def _compared(self, run: Run, old: Mapping[str, Any], new: Mapping[str, Any]) -> dict[str, Any]:
        """The differences to an earlier evaluation of the run: episode by episode where both played the same ones."""
        before = Sample(int(old["episodes"]), float(old["mean_return"]), float(old.get("std_return") or 0.0))
        found = None
        if are_paired(new, old):
            with contextlib.suppress(OSError, ValueError):  # its table is gone, or damaged
                table = run.evaluations / f"{old['name']}.parquet"
                found = paired(self.played.returns.tolist(), read_returns(table))
        return {
            "name": old["name"],
            "checkpoint": checkpoint_of(old["name"]),
            "time": old["time"],
            "other_worlds": (old.get("config") or {}) != (new.get("config") or {}),
            "return": found or difference(Sample.of(self.played.returns), before),
        }


class Judged(Protocol):
    """The results of a job's episodes by the rules of its section."""

    def summary(self) -> dict[str, Any]:
        """As JSON values, for the evaluation's summary."""

    def columns(self) -> dict[str, list[Any]]:
        """Further columns of the evaluation's table, a value for each episode."""

    def write(self, folder: Path) -> None:
        """Write further files into the directory of the evaluation. Raises OSError."""


class Watcher(Protocol):
    """Watches the episodes of a job whose section has its own rules, one in each world.

    ``task``: at the start of the episodes.
    """

    def __init__(self, task: Any) -> None: ...

    def note(self, running: torch.Tensor) -> None:
        """Called after each control step with the worlds whose episode had not ended before it, shape ``(worlds,)``, bool."""

    def result(self, played: Episodes, section: Mapping[str, Any], seed: int, facts: Mapping[str, Any]) -> Judged:
        """The results.

        Args:
            played: The record of each.
            section: Of the job.
            seed: Of the worlds.
            facts: The checkpoint's manifest.
        """


def evaluate(
    task: Task,
    policy: Policy,
    gang: Gang,
    *,
    checkpoint: str,
    episodes: int | None = None,
    count: Callable[[int, int], None] = lambda done, total: None,
) -> EvaluatedEpisodes:
    """Run at least ``episodes`` episodes, by default one a world; all ranks call it. The worlds are left as they were.

    ``count``: See :func:`worker.evaluation.episodes.play`.
    """
    started = time.perf_counter()
    before = task.state_dict()
    worlds = int(gang.sum(torch.tensor(float(task.world_count), device=gang.device)))
    played = play([task] * (1 if episodes is None else math.ceil(episodes / worlds)), policy, gang, count=count)
    task.load_state_dict(before)
    task.clear_statistics()
    return result_of(task, played, checkpoint, None, started)


def result_of(task: Task, played: Episodes, checkpoint: str, seed: int | None, started: float) -> EvaluatedEpisodes:
    """The evaluation of these episodes; ``started`` by ``time.perf_counter``."""
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


def best_line(run: Run) -> str:
    """A line on the checkpoint that is the best by evaluations, for the end of a training; empty where none can be compared."""
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


def write_table(
    path: Path,
    played: Episodes,
    seed: int | None,
    facts: Mapping[str, str],
    further: Mapping[str, Sequence[Any]] | None = None,
) -> None:
    """Write the episodes, whole or not at all. The same episodes are the same bytes. Raises OSError.

    Columns: ``episode`` (its number), ``seed`` (of the worlds; none of those of a training), ``return``, ``length`` [steps], ``success``,
    ``cause``, and of each term ``reward_NAME`` (weighted sum) or ``metric_NAME`` (mean over the steps, or the last value).

    Args:
        path: Of the file.
        played: The episodes.
        seed: Of the worlds.
        facts: What was evaluated, for the key-value metadata of the file: ``run``, ``checkpoint``, ``task``, ``config`` (JSON).
        further: Columns of further facts, by name; numbers are float64 unless all are whole.
    """
    import pyarrow as arrow
    import pyarrow.parquet

    count = len(played.rows)
    successes = played.successes
    columns = {
        "episode": arrow.array(range(count), arrow.int64()),
        "seed": arrow.array([seed] * count, arrow.int64()),
        # of float32 sums: no digit of them is lost
        "return": arrow.array(played.returns.numpy(), arrow.float64()),
        "length": arrow.array(played.lengths.long().numpy(), arrow.int64()),
        "success": arrow.array([None] * count if successes is None else successes.tolist(), arrow.bool_()),
        "cause": arrow.array(played.ends, arrow.string()),
        **{name: arrow.array(played.term(name).numpy(), arrow.float64()) for name in played.terms},
    }
    for name, values in (further or {}).items():
        whole = all(isinstance(value, int) for value in values)
        text = all(isinstance(value, str) for value in values)
        columns[name] = arrow.array(values, arrow.string() if text else arrow.int64() if whole else arrow.float64())
    buffer = io.BytesIO()
    pyarrow.parquet.write_table(arrow.table(columns).replace_schema_metadata(dict(facts)), buffer)
    for left in path.parent.glob(f".{path.name}.*.tmp"):  # of an evaluation that was killed
        left.unlink(missing_ok=True)
    write_atomic(path, buffer.getvalue())


def _rewards(summary: Mapping[str, Any]) -> list[Any]:
    """The rewards of an evaluation: returns of other rewards can't be compared."""
    terms, changes = summary.get("rewards") or {}, summary.get("config") or {}
    own = {key: value for key, value in changes.items() if key.startswith("reward")}
    return [{name: term.get("weight") for name, term in terms.items()}, own]


def _finite(value: Any) -> Any:
    """JSON has no infinity: None in its place."""
    if isinstance(value, Mapping):
        return {key: _finite(each) for key, each in value.items()}
    return None if isinstance(value, float) and not math.isfinite(value) else value
