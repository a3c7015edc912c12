"""A compiled reward function: the Warp function of its translation, and its launch over the arrays of all cars."""

from __future__ import annotations

import functools
import hashlib
import linecache
from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from racer.rewards.parameters import MOST_OBJECTS, NUMBERS, OBJECT_NUMBERS, Point
from racer.rewards.problems import Failure
from racer.rewards.translation.translate import failure_message

wp.set_module_options({"enable_backward": False})


@wp.struct
class RaceArrays:
    """Arguments of all cars' reward functions in one step.

    Attributes:
        numbers: A row a car, shape ``(worlds, NUMBERS)``: :data:`~racer.rewards.parameters.NUMBER_COLUMNS`, then how many objects
            there are and the row of the car's track.
        objects: Of each car its objects, shape ``(worlds, MOST_OBJECTS, OBJECT_NUMBERS)``:
            :data:`~racer.rewards.parameters.OBJECT_COLUMNS`.
        waypoints: Centre lines of the tracks [m], shape ``(tracks, longest, 2)``.
        counts: How many waypoints each track has, shape ``(tracks,)``.
        errors: Of each car the last error of its reward function (16 times the line, and its number in
            :data:`~racer.rewards.translation.prelude.ERRORS`) and how many there were, shape ``(worlds, 2)``.
        values: Of each car the last reward that was too large, shape ``(worlds,)``.
    """

    numbers: wp.array2d[wp.float32]
    objects: wp.array3d[wp.float32]
    waypoints: wp.array3d[wp.float32]
    counts: wp.array[wp.int32]
    errors: wp.array2d[wp.int32]
    values: wp.array[wp.float32]


def race_arrays(worlds: int, tracks: Sequence[Sequence[Point]], device: str) -> Any:
    """Arrays for so many cars, all zero but the tracks.

    Args:
        worlds: Cars.
        tracks: Waypoints of each track [m].
        device: Where they are.
    """
    race = RaceArrays()
    lines = np.zeros((len(tracks), max(map(len, tracks)), 2), dtype=np.float32)
    for row, track in zip(lines, tracks, strict=True):
        row[: len(track)] = track
    race.numbers = wp.zeros((worlds, NUMBERS), dtype=wp.float32, device=device)
    race.objects = wp.zeros((worlds, MOST_OBJECTS, OBJECT_NUMBERS), dtype=wp.float32, device=device)
    race.waypoints = wp.array(lines, dtype=wp.float32, device=device)
    race.counts = wp.array([len(track) for track in tracks], dtype=wp.int32, device=device)
    race.errors = wp.zeros((worlds, 2), dtype=wp.int32, device=device)
    race.values = wp.zeros(worlds, dtype=wp.float32, device=device)
    return race


@functools.cache
def warp_function(snippet: str) -> Any:
    """A Warp function of ``(world: int, race: RaceArrays) -> float``, which terms and kernels may call.

    Args:
        snippet: Its C++ body (:func:`racer.rewards.translation.translate`).

    A car whose reward has no value gets NaN, and a row of ``race.errors`` that says why.
    """
    name = f"reward_{hashlib.sha256(snippet.encode()).hexdigest()[:12]}"
    scope: dict[str, Any] = {"wp": wp, "RaceArrays": RaceArrays, "snippet": snippet, "__name__": f"muster.{name}"}
    # Warp reads the type of the result only where it sees this decorator
    _run(f"@wp.func_native(snippet)\ndef {name}(world: int, race: RaceArrays) -> float:\n    ...\n", name, scope)
    return scope[name]


def kernels(functions: Sequence[Any], name: str) -> list[Any]:
    """Kernels that call one reward function each for every car: ``(race, rewards)``; all of them are one module of Warp."""
    scope: dict[str, Any] = {"wp": wp, "RaceArrays": RaceArrays, "__name__": f"muster.{name}"}
    parts = []
    for number, function in enumerate(functions):
        scope[f"function_{number}"] = function
        parts.append(
            f"def reward_all_{number}(race: RaceArrays, rewards: wp.array[wp.float32]):\n"
            f"    world = wp.tid()\n    rewards[world] = function_{number}(world, race)\n"
        )
    _run("\n".join(parts), name, scope)
    module = wp.get_module(f"muster.{name}")
    module.options["enable_backward"] = False
    return [
        wp.kernel(scope[f"reward_all_{number}"], module=module, enable_backward=False) for number in range(len(parts))
    ]


def _run(text: str, name: str, scope: dict[str, Any]) -> None:
    """Define what a text defines; Warp finds it again under the name of its file."""
    file = f"<{name}>"
    linecache.cache[file] = (len(text), None, [f"{line}\n" for line in text.split("\n")], file)
    exec(compile(text, file, "exec"), scope)


def failures_of(race: Any) -> dict[int, tuple[str, Failure]]:
    """The calls that gave no reward, by the number in ``race.errors``: the message of the first car, and how many. Waits for the device."""
    errors, values, found = race.errors.numpy(), race.values.numpy(), dict[int, tuple[str, Failure]]()
    for car in np.flatnonzero(errors[:, 1]).tolist():
        code, count = errors[car].tolist()
        found.setdefault(code, (failure_message(code, float(values[car])), Failure(0, car)))[1].count += count
    return found
