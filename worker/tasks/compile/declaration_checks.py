"""Checks of a declaration."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from shared_store.contract.error_text import nearest, shown
from worker.tasks.compile.numbers import flat

if TYPE_CHECKING:
    from worker.simulation.declared_randomization import Randomize
    from worker.tasks.compile.binding import Bound
    from worker.tasks.declare import declaration


def check_observation(place: str, term: declaration.Observation, columns: int) -> None:
    """Raise ValueError for invalid options of an observation, or options that do not fit its columns."""
    if term.noise_kind not in ("uniform", "normal") or not _is_number(term.noise) or term.noise < 0:
        found = term.noise if term.noise_kind == "uniform" else (term.noise_kind, term.noise)
        raise ValueError(
            f'{place}: noise is {shown(found)}; give half the width, 0 or more, or ("normal", standard deviation)'
        )
    delay = term.delay
    if not _is_pair(delay) or not all(map(_is_whole, delay)) or not 0 <= delay[0] <= delay[1]:
        raise ValueError(
            f"{place}: delay is {shown(delay)}; give whole control steps, from 0 up, or two, the lesser first"
        )
    if not _is_whole(term.history) or term.history < 1:
        raise ValueError(f"{place}: history is {shown(term.history)}; it counts the present step, so it is 1 or more")
    if not isinstance(term.unit, str) and len(term.unit) != columns:
        raise ValueError(f"{place}: {len(term.unit)} units for {columns} columns; give one for all, or one for each")


def check_result(bound: Bound, section: str) -> None:
    """Refuse a function whose result its section can't use."""
    if bound.signature is None:
        if section in ("events", "commands", "actions", "curricula"):
            raise ValueError(
                f"{bound.place}: a torch term observes, rewards or ends an episode; write this one as a @wp.func"
            )
        if section in ("rewards", "metrics", "terminations") and bound.width != 1:
            raise ValueError(f"{bound.place}: size is {bound.width}; a term of this section gives one number a world")
        return
    returns = bound.signature.returns
    name = bound.signature.name
    if section in ("rewards", "metrics") and (returns is None or bound.width != 1):
        raise ValueError(f"{bound.place}: {name} must give a float (-> float), one number a world or element")
    if section == "terminations" and returns is not bool:
        raise ValueError(f"{bound.place}: {name} must give a bool (-> bool): whether the episode ends")
    if section.startswith("observations") and returns is None:
        raise ValueError(f"{bound.place}: {name} gives nothing; annotate its result, such as -> float")


def check_command(place: str, term: declaration.Command) -> None:
    """Raise ValueError for invalid names or units of a command."""
    if not term.names or not all(isinstance(name, str) for name in term.names):
        raise ValueError(f"{place}: names are {shown(term.names)}; name each number that the policy sees")
    if len(term.units) != len(term.names):
        raise ValueError(f"{place}: {len(term.units)} units for {len(term.names)} numbers; give one for each")
    if not _is_whole(term.hidden) or term.hidden < 0:
        raise ValueError(f"{place}: hidden is {shown(term.hidden)}; give how many numbers, from 0 up")


def check_randomized(
    entries: Mapping[str, Randomize], place: str, value: Any, where: str, *, fill: bool = False
) -> None:
    """Check the numbers that a job sets at a place of ``randomize``.

    Args:
        entries: As declared.
        place: Such as ``randomize.mass.range``.
        value: The numbers.
        where: Their source, for the error.
        fill: Whether all numbers of the place become ``value``.

    Raises:
        ValueError: The place does not exist, or the entry can't have these numbers.
    """
    name, _, own = place.removeprefix("randomize.").partition(".")
    known = [f"randomize.{key}.{each}" for key, entry in entries.items() for each in entry.places]
    if place not in known:
        raise ValueError(f"{where}: the task has no number {shown(place)}; {nearest(place, known) or 'it has none'}")
    count = entries[name].places[own]
    numbers = flat(f"{where}.{place}", [value] * count if fill else value, count)
    with placed(f"{where}.{place}"):
        entries[name].check_numbers(own, numbers)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _is_whole(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)


def _is_pair(value: Any) -> bool:
    return isinstance(value, tuple | list) and len(value) == 2


@contextmanager
def placed(where: str) -> Iterator[None]:
    """Prefix a ValueError with its place in the task."""
    try:
        yield
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from error
