"""The elements of a compiled model: their names, and which is which in two models of one robot."""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Any

import mujoco

Pairs = dict[int, int]
"""Index of an element in the built model, by its index in the file's."""


def name_of(model: Any, kind: mujoco.mjtObj, index: int) -> str:
    """An element's name, or one made of its kind and its number where the file gives none.

    Args:
        model: A compiled model, ``mujoco.MjModel``.
        kind: Kind of the element.
        index: Its index among those of its kind.
    """
    name: str | None = mujoco.mj_id2name(model, kind, index)
    return name or f"{mujoco.mju_type2Str(kind)}_{index}"


def plain(name: str) -> str:
    """A name as Newton's importer keeps it: other characters than letters, digits and underscores become underscores."""
    return re.sub(r"\W", "_", name)


def short(label: str) -> str:
    """The last part of a label of Newton's, which is the element's name."""
    return label.rpartition("/")[2]


def kind_of(word: str) -> mujoco.mjtObj:
    """A kind of elements by its word in MJCF."""
    return mujoco.mjtObj.__members__[f"mjOBJ_{word.upper()}"]


def word_of(kind: Any, value: int) -> str:
    """The word of MJCF for a value of one of MuJoCo's enumerations."""
    return str(kind(int(value)).name.rpartition("_")[2].lower())


class Words:
    """The words of MJCF for values of one of MuJoCo's enumerations, as far as Newton's models have them."""

    def __init__(self, kind: Any, words: str) -> None:
        self._kind = kind
        prefix = next(iter(kind.__members__)).partition("_")[0]
        self._words = {int(kind.__members__[f"{prefix}_{word.upper()}"]): word for word in words.split()}

    def of(self, value: Any, element: str) -> str:
        """The word of a value of an element. Raises ValueError, with the element's name, where Newton has nothing of the kind."""
        if int(value) not in self._words:
            raise ValueError(
                f"{element} is of the kind {word_of(self._kind, value)!r}, which Newton's models don't have"
            )
        return self._words[int(value)]


COUNTS = {"body": "nbody", "joint": "njnt", "actuator": "nu", "equality": "neq"}
"""Fields of ``mujoco.MjModel`` that count elements, where they are not an n and the kind's word."""


def count_of(model: Any, kind: str) -> int:
    """Number of a model's elements of a kind."""
    return int(getattr(model, COUNTS.get(kind, f"n{kind}")))


def unique_names(model: Any, kind: str) -> list[str]:
    """Names of all elements of a kind, as Newton's importer keeps them and each once; made ones where the file gives none."""
    count = range(count_of(model, kind))
    named = {index: bool(mujoco.mj_id2name(model, kind_of(kind), index)) for index in count}
    names: dict[int, str] = {}
    taken: set[str] = set()
    for index in sorted(count, key=lambda each: not named[each]):  # the file's own names first
        name = plain(name_of(model, kind_of(kind), index))
        while name in taken:
            name += "_"
        taken.add(name)
        names[index] = name
    return [names[index] for index in count]


def names_of(model: Any, kind: str, indices: Iterable[int]) -> dict[int, str]:
    """Names of elements as Newton's importer keeps them, each once; empty where the file gives none."""
    names = unique_names(model, kind)
    return {index: names[index] if mujoco.mj_id2name(model, kind_of(kind), index) else "" for index in indices}


def paired(there: dict[int, str], here: dict[int, str]) -> Pairs:
    """Match elements by name, and those without a name in their order."""
    by_name = {name: index for index, name in here.items()}
    pairs = {index: by_name[name] for index, name in there.items() if name and name in by_name}
    rest = [index for index in here if index not in pairs.values()]
    unnamed = [index for index, name in there.items() if not name]
    return pairs | dict(zip(unnamed, rest, strict=False))


def some(names: list[str]) -> str:
    """The first names, for a sentence."""
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")
