"""Needs of a term's function beyond its parameters' types, declared beside the function and so known wherever it is used.

>>> @needs(memory_each=1)
... @wp.func
... def greatest(world: int, episodes: EpisodeArrays, robot: RobotArrays, joint: int, memory: int) -> float: ...
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, TypeVar

_Function = TypeVar("_Function")


@dataclass(frozen=True)
class Needs:
    """The needs of a function.

    Attributes:
        memory: Numbers of its own in ``episodes.memory``.
        memory_each: Further ones for each value that its element may have: each joint of the robot, or each ``index``.
        command: Numbers of its command that the policy sees; a function that draws a command writes exactly that many.
        hidden: Numbers of its command behind those.
        size: How many values ``index`` has, where it counts elements of the function's own.
        each: How many values ``index`` has for each column of the sensors.
        columns: The parameters whose sensors have a column for each ``index``; None: all that have columns.
        points: The number that says how many columns of its height scan belong to one ``index``; empty: one column each.
        numbers: Whether ``index`` counts the numbers of the command.
        ranges: Whether the joints must have limits of their positions.
        some_ranges: Whether at least one of the joints must have such limits, since the function does nothing for the others.
        efforts: Whether the joints must have actuators with limits of their forces.
        free_root: Whether the root must be free, since the function moves it.
        kind: What an action's function writes to an actuator: ``"effort"``, ``"position"`` or ``"velocity"``; empty: unknown.
    """

    memory: int = 0
    memory_each: int = 0
    command: int = 0
    hidden: int = 0
    size: int = 0
    each: int = 1
    columns: tuple[str, ...] | None = None
    points: str = ""
    numbers: bool = False
    ranges: bool = False
    some_ranges: bool = False
    efforts: bool = False
    free_root: bool = False
    kind: Literal["", "effort", "position", "velocity"] = ""


NOTHING = Needs()
_NEEDS: dict[Any, Needs] = {}


def needs(**options: Any) -> Callable[[_Function], _Function]:
    """Declare the needs of a term's function; the decorator stands above ``@wp.func``.

    Args:
        **options: As for :class:`Needs`.
    """
    declared = Needs(**options)

    def note(function: _Function) -> _Function:
        _NEEDS[function] = declared
        return function

    return note


def needs_of(function: Any) -> Needs:
    """The declared needs of a function; :data:`NOTHING` by default."""
    try:
        return _NEEDS.get(function, NOTHING)
    except TypeError:  # not hashable, so not a function
        return NOTHING
