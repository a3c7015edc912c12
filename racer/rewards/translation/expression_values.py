"""The values of a reward function's expressions during translation.

What is known is a value of Python itself: a number, a text, None, or a list, tuple or dictionary of such. The classes here stand for what is known
only when the function runs, and for what it calls. The *shape* of a value is the type of a variable that holds it: numbers without code, in the lists
and tuples in which they stand; where nothing has to be held, the value itself.
"""

from __future__ import annotations

import ast
import inspect
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

Value = Any
"""A value of Python, or one of the classes of this module."""
KINDS: Mapping[type, str] = {bool: "bool", int: "int", float: "float", str: "text"}
ORDER = ("bool", "int", "float")
"""Kinds of numbers, from the narrowest on; a variable has the widest of its values."""
C_TYPES = {"bool": "bool", "int": "long long", "float": "double", "text": "int"}
LONGEST_GROUP = 16
"""Longest list or tuple whose items each have a variable."""


class Outside(Exception):
    """A reward function is outside the subset that is translated.

    Args:
        node: What is; or its line.
        reason: What it is, as the subject of a sentence.
    """

    def __init__(self, node: ast.AST | int, reason: str) -> None:
        self.line = node if isinstance(node, int) else getattr(node, "lineno", 0)
        self.reason = reason
        super().__init__(f"line {self.line}: {reason}: such functions run in Python workers")


@dataclass(frozen=True)
class Number:
    """A number or truth value, or a text, of which only its number among all texts is kept.

    Attributes:
        kind: ``bool``, ``int``, ``float`` or ``text``.
        code: A C++ expression without effects but errors; empty in a shape.
    """

    kind: str
    code: str = ""


@dataclass(frozen=True)
class Series:
    """Items of which some are known only when it runs: waypoints, objects, a range, a zip.

    Attributes:
        name: In messages.
        length: How many there are.
        item: From an index that is valid to the item.
        is_list: Whether it is a list of ``params``, which variables may hold and of which items may be taken.
    """

    name: str
    length: Value
    item: Callable[[Value], Value] = field(repr=False)
    is_list: bool = False


@dataclass(frozen=True)
class Function:
    """A function of the file.

    Attributes:
        name: Its name.
        node: Where it is defined.
        scope: The function or module around it, whose variables it sees.
        signature: Its parameters, with known values of those that a call may leave out.
    """

    name: str
    node: Any
    scope: Any = field(repr=False)
    signature: inspect.Signature = field(repr=False, compare=False)


@dataclass(frozen=True)
class Known:
    """``params`` itself, a module, or a function that is built in or a module's; ``kind`` says which, ``name`` is dotted."""

    kind: str
    name: str


PARAMS = Known("params", "params")


def is_known(value: Value) -> bool:
    """Whether a value is one of Python's, through and through."""
    if isinstance(value, list | tuple):
        return all(map(is_known, value))
    return value in (None, ...) or type(value) in KINDS or (isinstance(value, dict) and is_known([*value.values()]))


def is_table(value: Value) -> bool:
    """Whether a list or tuple is known and too long for a variable per item."""
    return isinstance(value, list | tuple) and _count(value) > LONGEST_GROUP and is_known(value)


def _count(value: Value) -> int:
    return sum(map(_count, value)) if isinstance(value, list | tuple) else 1


def kind_of(value: Value) -> str | None:
    """The kind of a number, truth value or text; None for all else."""
    return value.kind if isinstance(value, Number) else KINDS.get(type(value))


def shape_of(value: Value, *, whole: bool = True) -> Value:
    """The shape of a value; not ``whole``: of a long list of constants, too, that of its items."""
    if kind := kind_of(value):
        return Number(kind)
    if isinstance(value, list | tuple) and not (whole and is_table(value)):
        return type(value)(shape_of(item, whole=whole) for item in value)
    return value


def kept(value: Value, node: ast.AST) -> Value:
    """The shape of a value that is kept; what holds good only where it is written is refused."""
    for item in value if isinstance(value, list | tuple) else [value]:
        if isinstance(item, Series) and not item.is_list:
            raise Outside(node, f"{item.name} that is kept for later")
    return shape_of(value)


def flat(shape: Value) -> list[str]:
    """The kinds of all numbers in a shape, in order."""
    if isinstance(shape, list | tuple):
        return [kind for item in shape for kind in flat(item)]
    return [shape.kind] if isinstance(shape, Number) else []


def rebuilt(shape: Value, names: Iterator[str]) -> Value:
    """The value of a shape whose numbers are held by ``names``, in order."""
    if isinstance(shape, list | tuple):
        return type(shape)(rebuilt(item, names) for item in shape)
    return Number(shape.kind, next(names)) if isinstance(shape, Number) else shape


def joined(one: Value, other: Value) -> Value:
    """The shape of a variable that holds values of both shapes.

    Raises:
        ValueError: There is none.
    """
    if repr(one) == repr(other):
        return one
    if isinstance(one, Number) and isinstance(other, Number) and "text" not in (one.kind, other.kind):
        return Number(max(one.kind, other.kind, key=ORDER.index))
    if isinstance(one, list | tuple) and type(one) is type(other) and len(one) == len(other):
        return type(one)(map(joined, one, other))
    raise ValueError


def described(value: Value) -> str:
    """A value, or its shape, in words."""
    if kind := kind_of(value):
        return {"bool": "a truth value", "int": "an int", "float": "a float", "text": "a text"}[kind]
    if isinstance(value, list | tuple):
        return f"a {type(value).__name__} of {len(value)}"
    return "a constant dict" if isinstance(value, dict) else str(getattr(value, "name", None))
