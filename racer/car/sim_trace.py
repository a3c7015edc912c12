"""The simulation trace (SimTrace files): a row for each control step of an episode, and files that log tools need, as DeepRacer has them.

The layout is that of a model that DeepRacer on AWS exports, which ``deepracer-utils`` reads (``DeepRacerLog(folder)``):
``sim-trace/training/NAME/training-simtrace/``, ``sim-trace/evaluation/NAME/evaluation-simtrace/``, ``model/`` and ``ip/``.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from racer.car.resets import INCIDENTS
from racer.car.trace import COLUMNS
from racer.settings.hyperparameters import deepracer_names
from shared_store.volume.files import refuse_links, write_json

if TYPE_CHECKING:
    from racer.car.task import Racer

SIM_TRACE_COLUMNS = (
    *("episode", "steps", "X", "Y", "yaw", "steer", "throttle", "action", "reward", "done", "all_wheels_on_track"),
    *("progress", "closest_waypoint", "track_len", "tstamp", "episode_status", "pause_duration"),
    *("obstacle_crash_counter", "wall_clock"),
)
"""Of a SimTrace file, as DeepRacer's community reads it."""
CONTINUOUS = -1.0
"""Number of an action that is not a choice."""
_STATUS = {"time_out": "time_up"}
"""SimTrace's names of ends where they differ from ours."""


def sim_trace(
    rows: Sequence[Sequence[float]],
    clocks: Sequence[float],
    status: str,
    *,
    episode: int,
    length: float,
    control_hz: float,
) -> Iterator[str]:
    """The lines of one episode; positions are those of the front, angles are in degrees.

    The first row, ``prepare``, is the car at the start: tools count steps and time from there.

    Args:
        rows: Of the car before the first control step and after each: :data:`racer.car.trace.COLUMNS`, the reward, and the number
            of the action, :data:`CONTINUOUS` where actions are continuous.
        clocks: When each control step was done, by the clock [s].
        status: By what the episode ended.
        episode: Its number.
        length: Of the track's centre line [m].
        control_hz: Control steps a second [Hz].
    """
    before, chooses = [0.0] * len(INCIDENTS), rows[-1][-1] != CONTINUOUS
    for number, row in enumerate(rows):
        car = dict(zip((*COLUMNS, "reward", "action"), row, strict=True))
        counts = [car[name] for name in INCIDENTS]
        state = next((name for name, now, then in zip(INCIDENTS, counts, before, strict=True) if now > then), "")
        before = counts
        state = state or ("in_progress" if number else "prepare")
        if done := number == len(rows) - 1:
            state = _STATUS.get(status, status)
        steering, speed = math.degrees(car["steering"]), car["speed"]
        action = f"{car['action']:.0f}" if chooses else f"[{steering:.4f} {speed:.4f}]"
        yield ",".join(
            (
                *(f"{episode}", f"{number}", f"{car['x']:.4f}", f"{car['y']:.4f}"),
                *(f"{math.degrees(car['heading']):.4f}", f"{steering:.2f}"),
                *(f"{speed:.2f}", action, f"{car['reward']:.4f}", f"{done}"),
                *(f"{car['wheels'] == 4}", f"{car['progress']:.4f}", f"{car['waypoint']:.0f}"),
                *(f"{length:.2f}", f"{number / control_hz:.3f}", state, "0.00"),
                *(f"{car['crashed']:.0f}", f"{clocks[max(0, number - 1)]:.3f}"),
            )
        )


def model_documents(task: Racer, algorithm: str, settings: Mapping[str, Any], worlds: int) -> dict[str, Any]:
    """The files about the model by their paths beside ``sim-trace``: action space and hyperparameters, under DeepRacer's names.

    Args:
        task: The cars.
        algorithm: Name of the algorithm that has learnt, or learns.
        settings: Its settings.
        worlds: Of each rank.
    """
    front = getattr(task.config, "front", None)
    metadata = task.bundle_documents(algorithm)["model_metadata.json"]
    return {
        "model/model_metadata.json": {**metadata, "neural_network": "CNN" if front else "MLP"},
        "ip/hyperparameters.json": deepracer_names(algorithm, settings, worlds, front.frames if front else 1),
    }


def write_documents(folder: Path, documents: Mapping[str, Mapping[str, Any]]) -> None:
    """Write :func:`model_documents` below ``folder``. Raises OSError, and DamagedFile if a link is in the place of a directory."""
    for name, document in documents.items():
        refuse_links((folder / name).parent, 1)
        write_json(folder / name, document)
