"""The numbers of a declaration, each with a place, in one array that every kernel of the task reads."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from difflib import get_close_matches
from typing import Any

import warp as wp

from shared_store.contract.error_text import nearest, shown

EXPRESSIONS: Mapping[Any, str] = {
    float: "numbers[{0}]",
    wp.float32: "numbers[{0}]",
    int: "int(numbers[{0}])",
    wp.int32: "int(numbers[{0}])",
    bool: "(numbers[{0}] != 0.0)",
    wp.vec2: "wp.vec2(numbers[{0}], numbers[{1}])",
    wp.vec3: "wp.vec3(numbers[{0}], numbers[{1}], numbers[{2}])",
    wp.vec4: "wp.vec4(numbers[{0}], numbers[{1}], numbers[{2}], numbers[{3}])",
    wp.quat: "wp.quat(numbers[{0}], numbers[{1}], numbers[{2}], numbers[{3}])",
    wp.transform: "wp.transform(wp.vec3(numbers[{0}], numbers[{1}], numbers[{2}]), "
    "wp.quat(numbers[{3}], numbers[{4}], numbers[{5}], numbers[{6}]))",
}
"""The expression by which a kernel reads a value of each type from the array."""


Check = Callable[[list[float]], str | None]
"""The error in the numbers of a place, in a few words; None: they are valid."""


def in_order(ends: list[float]) -> str | None:
    """Least and greatest value."""
    return None if ends[0] <= ends[1] else f"expected the lesser number first, found {ends}"


def are_times(ends: list[float]) -> str | None:
    """Least and greatest time [s]."""
    if 0.0 < ends[0] <= ends[1] < math.inf:
        return None
    return f"expected the least and the greatest time, above 0 and finite, found {ends}"


def is_amount(values: list[float]) -> str | None:
    """Numbers from 0 up."""
    return None if min(values) >= 0.0 and max(values) < math.inf else f"expected 0 or more, found {values}"


def stays(declared: float) -> Check:
    """Accept only the declared number."""
    return lambda values: (
        None if values == [float(declared)] else f"the declaration alone can change it from {declared}"
    )


class Numbers:
    """All numbers of a task, in the order in which they are added.

    Attributes:
        values: One after the other.
        places: First index and count of each place, such as ``rewards.track_linear.std``.
        others: Places of numbers that are kept elsewhere, those of ``randomize``: for errors about a place that does not exist.
    """

    def __init__(self) -> None:
        self.values: list[float] = []
        self.places: dict[str, tuple[int, int]] = {}
        self.others: list[str] = []
        self._checks: dict[str, Check] = {}

    def add(self, place: str, value: Any, count: int, check: Check | None = None) -> int:
        """Add the ``count`` numbers of a place; returns the index of the first.

        Args:
            place: Of the numbers.
            value: As declared.
            count: How many there must be.
            check: A further check, now and whenever a job changes them.

        Raises:
            ValueError: The value is not that many numbers, or ``check`` refuses them.
        """
        first = len(self.values)
        if check is not None:
            self._checks[place] = check
        self.values += self._checked(place, place, value, count)
        self.places[place] = (first, count)
        return first

    def pair(self, first: int) -> tuple[float, float]:
        """The two numbers from index ``first`` on."""
        least, greatest = self.values[first : first + 2]
        return least, greatest

    def _checked(self, shown_place: str, place: str, value: Any, count: int) -> list[float]:
        numbers = flat(shown_place, value, count)
        complaint = self._checks[place](numbers) if place in self._checks else None
        if complaint:
            raise ValueError(f"{shown_place}: {complaint}")
        return numbers

    def set(self, place: str, value: Any, where: str) -> None:
        """Change the numbers of a place, as ``config.numbers`` says under ``where``.

        Raises:
            ValueError: The place does not exist, or the value has another count of numbers or is not valid there.
        """
        first, count = self.find(place, where)
        self.values[first : first + count] = self._checked(f"{where}.{place}", place, value, count)

    def check_filled(self, place: str, value: float, where: str) -> None:
        """Check a value that a curriculum will give all numbers of a place. Raises ValueError."""
        _, count = self.find(place, where)
        self._checked(f"{where}.{place}", place, [value] * count, count)

    def find(self, place: str, where: str) -> tuple[int, int]:
        """First index and count of a place.

        Raises:
            ValueError: The place does not exist.
        """
        if place not in self.places:
            known = sorted((*self.places, *self.others))
            raise ValueError(f"{where}: the task has no number {shown(place)}; {_nearest_place(place, known)}")
        return self.places[place]


def _nearest_place(place: str, known: Sequence[str]) -> str:
    """The place that was meant, if all of it is similar, or its last name, such as ``speed`` of ``push_speed``; else all places."""
    last = {name.rpartition(".")[2]: name for name in reversed(known)}
    near = get_close_matches(place.rpartition(".")[2], last, n=1, cutoff=0.75)
    return nearest(place, known, f"did you mean {last[near[0]]}?" if near else "")


def flat(place: str, value: Any, count: int) -> list[float]:
    """A value of the declaration as ``count`` numbers.

    Raises:
        ValueError: It is not that many numbers, or one is NaN.
    """
    found = [value] if isinstance(value, int | float) else list(value) if _is_sequence(value) else None
    if found is None or len(found) != count or not all(isinstance(each, int | float) for each in found):
        expected = "a number" if count == 1 else f"{count} numbers"
        raise ValueError(f"{place}: expected {expected}, found {shown(value)}")
    numbers = [float(each) for each in found]
    if any(math.isnan(each) for each in numbers):
        raise ValueError(f"{place}: a number can't be NaN")
    return numbers


def _is_sequence(value: Any) -> bool:
    return not isinstance(value, str) and (isinstance(value, Sequence) or hasattr(value, "__len__"))
