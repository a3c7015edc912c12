"""Race recording: each trial's control steps, times, penalties and SimTrace files."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
import warp as wp

from racer.car.sim_trace import CONTINUOUS, SIM_TRACE_COLUMNS, model_documents, sim_trace, write_documents
from racer.car.trace import COLUMNS
from racer.store.races import SIM_TRACE, rules_of
from shared_store.volume.files import make_directory, write_atomic
from worker.simulation.capture import on_torch_stream

if TYPE_CHECKING:
    from racer.car.task import Racer
    from worker.evaluation.episodes import Episodes

COMPLETE = "lap_complete"
_CALLED = {"off_tracks": "off_track", "crashes": "crashed", "immobilized": "immobilized", "reversed": "reversed"}
"""A trial's names for the counts of incidents."""


@dataclass(frozen=True)
class Trial:
    """A lap from the start line, as far as it went.

    Attributes:
        start: The row of the car before its first control step, shape ``(15,)``: :data:`racer.car.trace.COLUMNS`, the reward, and the
            action, which is -1 where actions are continuous.
        steps: The rows after each control step, shape ``(steps, 15)``.
        clocks: When each was done, by the clock [s].
        status: By what it ended.
        track: Name of the track.
        length: Of its centre line [m].
        control_hz: Control steps a second [Hz].
    """

    start: torch.Tensor
    steps: torch.Tensor
    clocks: Sequence[float]
    status: str
    track: str
    length: float
    control_hz: float

    def summary(self, number: int, rules: Mapping[str, Any], seed: int) -> dict[str, Any]:
        """Times in simulated seconds: ``lap_time`` without penalties, null of a lap that is not complete, ``time`` with them."""
        seconds = len(self.steps) / self.control_hz
        counts = {name: int(self.steps[-1, COLUMNS.index(kind)]) for name, kind in _CALLED.items()}
        penalty = counts["off_tracks"] * rules["off_track_penalty"] + counts["crashes"] * rules["crash_penalty"]
        return {
            "trial": number,
            "status": self.status,
            "completion": float(self.steps[-1, COLUMNS.index("progress")]),
            "lap_time": seconds if self.status == COMPLETE else None,
            "time": seconds + penalty,
            **counts,
            "resets": int(self.steps[-1, COLUMNS.index("resets")]),
            "penalty": float(penalty),
            "steps": len(self.steps),
            "seed": seed,
        }

    def sim_trace(self, episode: int) -> Iterator[str]:
        """The lines of its SimTrace file, see :func:`racer.car.sim_trace.sim_trace`."""
        yield ",".join(SIM_TRACE_COLUMNS)
        yield from sim_trace(
            [self.start.tolist(), *self.steps.tolist()],
            self.clocks,
            self.status,
            episode=episode,
            length=self.length,
            control_hz=self.control_hz,
        )


@dataclass(frozen=True)
class RaceTrials:
    """The trials of a race.

    Attributes:
        trials: In their order.
        rules: See :func:`racer.store.races.rules_of`.
        directions: In which each track is driven, by its name.
        seed: Of the worlds.
        documents: Files about the model, see :func:`racer.car.sim_trace.model_documents`.
    """

    trials: Sequence[Trial]
    rules: Mapping[str, Any]
    directions: Mapping[str, str]
    seed: int
    documents: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)

    def summary(self) -> dict[str, Any]:
        """As JSON values. Best, average and total are of complete laps with their penalties; there is a total where all are complete."""
        trials = [trial.summary(number, self.rules, self.seed) for number, trial in enumerate(self.trials, 1)]
        laps = [trial["time"] for trial in trials if trial["status"] == COMPLETE]
        total = math.fsum(laps)
        return {
            "rules": dict(self.rules),
            "track": list(self.directions),
            "direction": ", ".join(dict.fromkeys(self.directions.values())),
            "trials": trials,
            "completed": len(laps),
            "total_time": total if len(laps) == len(trials) else None,
            "best_lap": min(laps, default=None),
            "average_lap": total / len(laps) if laps else None,
            **{name: sum(trial[name] for trial in trials) for name in ("off_tracks", "crashes", "resets")},
        }

    def columns(self) -> dict[str, list[Any]]:
        """The columns of a trial in a table."""
        trials = self.summary()["trials"]
        return {name: [trial[name] for trial in trials] for name in trials[0] if name != "seed"}

    def write(self, evaluation: Path) -> None:
        """Write a SimTrace file for each trial below the directory of an evaluation, in the layout that log tools look for, and what
        they look for beside them.

        Raises OSError.
        """
        folder = evaluation / SIM_TRACE / "evaluation" / evaluation.name / "evaluation-simtrace"
        make_directory(folder, 6)
        for episode, trial in enumerate(self.trials):
            text = "\n".join(trial.sim_trace(episode)) + "\n"
            write_atomic(folder / f"{episode}-iteration.csv", text.encode())
        write_documents(evaluation, self.documents)


class Laps:
    """Looks on while trials are driven, one in each world.

    Args:
        task: Whose configuration has ``trace``; every episode begins where the present one does, at the start line.
    """

    def __init__(self, task: Racer) -> None:
        self._task = task
        car = task.sensors["car"]
        arrays = car.arrays
        self._trace = wp.to_torch(arrays.trace)
        with on_torch_stream(task.device):
            car.note()
        self._starts = torch.cat([self._trace.cpu(), torch.tensor([[0.0, -1.0]] * task.world_count)], 1)
        self._tracks = [task.circuit.tracks[number] for number in arrays.tracks.numpy().tolist()]
        self._noted: list[tuple[float, torch.Tensor, torch.Tensor]] = []

    def note(self, running: torch.Tensor) -> None:
        """Keep the last control step of the worlds whose trial had not ended before it, shape ``(worlds,)``, bool."""
        task = self._task
        action = task.actions if task.discrete else torch.full_like(task.rewards, CONTINUOUS)[:, None]
        rows = torch.cat([self._trace, task.rewards[:, None], action], 1)
        worlds = running.nonzero()[:, 0]
        self._noted.append((time.time(), worlds.cpu(), rows[worlds].cpu()))

    def result(self, played: Episodes, section: Mapping[str, Any], seed: int, facts: Mapping[str, Any]) -> RaceTrials:
        """As :class:`worker.evaluation.evaluation.Watcher` says."""
        return self.race(played, rules_of(section), seed, facts)

    def race(
        self, played: Episodes, rules: Mapping[str, Any], seed: int, facts: Mapping[str, Any] | None = None
    ) -> RaceTrials:
        """The race that these trials were.

        Args:
            played: How each ended.
            rules: Of the race.
            seed: Of the worlds.
            facts: The checkpoint's manifest, for the files about the model; None: there are none.
        """
        steps: list[list[torch.Tensor]] = [[] for _ in self._tracks]
        clocks: list[list[float]] = [[] for _ in self._tracks]
        for clock, worlds, rows in self._noted:
            for world, row in zip(worlds.tolist(), rows, strict=True):
                steps[world].append(row)
                clocks[world].append(clock)
        hz = self._task.config.control_hz
        trials = [
            Trial(start, torch.stack(rows), times, status, track.name, track.length, hz)
            for start, rows, times, status, track in zip(
                self._starts, steps, clocks, played.ends, self._tracks, strict=True
            )
        ]
        directions = {track.name: track.direction for track in self._tracks}
        documents = {}
        if facts and "settings" in facts:
            trained = facts["algorithm"], facts["settings"], facts["train"].get("worlds", 1)
            documents = model_documents(self._task, *trained)
        return RaceTrials(trials, rules, directions, seed, documents)
