"""The values of a reward function's expressions during translation: their type and their C++ text."""

from __future__ import annotations

import ast
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from shared_store.contract.error_text import shown

ORDER = ("bool", "int", "float")
"""Kinds of numbers, from the narrowest on; a variable has the widest of its values."""
C_TYPES = {"bool": "bool", "int": "long long", "float": "double", "text": "int"}
LETTERS = {"bool": "b", "int": "i", "float": "f", "text": "t"}
LONGEST_GROUP = 16
"""Items of a list or tuple that is kept in variables of its own, one each."""


class Outside(Exception):
    """A reward function is outside the subset that is translated.

    Args:
        node: What is; or its line.
        reason: What it is, as the subject of a sentence.
    """

    def __init__(self, node: ast.AST | int, reason: str) -> None:
        self.line = node if isinstance(node, int) else getattr(node, "lineno", 0)
        self.reason = reason
        super().__init__(str(self))

    def __str__(self) -> str:
        return f"line {self.line}: {self.reason}: such functions run in Python workers"


@dataclass(frozen=True)
class Number:
    """A number or truth value, or a text, of which only its number among all texts is kept.

    Attributes:
        kind: ``bool``, ``int``, ``float`` or ``text``.
        code: A C++ expression without effects.
        constant: Its value, where it is known.
    """

    kind: str
    code: str
    constant: Any = None


@dataclass(frozen=True)
class ItemList:
    """A tuple or list of known length, kept item by item."""

    items: tuple[Value, ...]


@dataclass(frozen=True)
class Constant:
    """A value that no variable holds: None, a text, a constant list, tuple or dictionary.

    Attributes:
        value: The value.
        name: Unique for each value, under which it is compared and stored.
    """

    value: Any
    name: str

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Constant) and self.name == other.name

    def __hash__(self) -> int:
        return hash(self.name)


@dataclass(frozen=True)
class RuntimeList:
    """A list whose length is known when it runs: waypoints, and the objects.

    Attributes:
        name: The key of ``params``.
        length: C++ expression.
        row: From an index that is valid to the element.
    """

    name: str
    length: str
    row: Callable[[str], Value]

    def __eq__(self, other: object) -> bool:
        return isinstance(other, RuntimeList) and self.name == other.name

    def __hash__(self) -> int:
        return hash(self.name)


@dataclass(frozen=True)
class Thing:
    """A name without a value: ``params`` itself, a module, a built-in function or a function of the file.

    Attributes:
        kind: ``params``, ``module``, ``builtin``, ``function`` or ``refused``.
        name: Of the module or function; why it is refused.
        node: Where a function is defined; where a thing is refused.
        scope: Variables that a function defined inside another one sees.
    """

    kind: str
    name: str
    node: Any = None
    scope: Any = None


Value = Number | ItemList | Constant | RuntimeList | Thing
Shape = str | tuple["Shape", ...] | Constant | RuntimeList | Thing
"""The type of a variable: the kind of a number, those of a group's items, or the value itself where nothing has to be held."""


def number(value: bool | int | float) -> Number:
    """A known number.

    Raises:
        OverflowError: A whole number beyond 64 bit.
    """
    if isinstance(value, bool):
        return Number("bool", "true" if value else "false", value)
    if isinstance(value, int):
        if abs(value) >= 2**62:
            raise OverflowError(f"{shown(value)} is beyond 64 bit")
        return Number("int", f"{value}LL" if value >= 0 else f"({value}LL)", value)
    if value != value:
        return Number("float", "((double)NAN)", value)
    if value in (float("inf"), float("-inf")):
        return Number("float", f"({'-' if value < 0 else ''}(double)INFINITY)", value)
    return Number("float", repr(value) if value >= 0 and str(value)[0] != "-" else f"({value!r})", value)


def cast(value: Number, kind: str) -> str:
    """C++ text of a number as another kind."""
    return value.code if value.kind == kind else f"({C_TYPES[kind]})({value.code})"


def parenthesised(code: str) -> str:
    """A condition in one pair of parentheses: compilers warn about two."""
    depth = 0
    for place, letter in enumerate(code):
        depth += (letter == "(") - (letter == ")")
        if depth == 0:
            return code if code[0] == "(" and place == len(code) - 1 else f"({code})"
    return f"({code})"


def shape_of(value: Value) -> Shape:
    """The type of a variable that holds a value."""
    if isinstance(value, Number):
        return value.kind
    if isinstance(value, ItemList):
        return tuple(shape_of(item) for item in value.items)
    return value


def joined(one: Any, other: Any) -> Any:
    """The type of a variable that holds values of both types; None: there is none."""
    if one == other:
        return one
    if isinstance(one, str) and isinstance(other, str):
        return ORDER[max(ORDER.index(one), ORDER.index(other))] if one in ORDER and other in ORDER else None
    if isinstance(one, tuple) and isinstance(other, tuple) and len(one) == len(other):
        items = tuple(joined(*pair) for pair in zip(one, other, strict=True))
        return None if None in items else items
    return None


def described(shape: Shape) -> str:
    """A variable's type in words."""
    if isinstance(shape, tuple):
        return f"a list of {len(shape)}"
    if isinstance(shape, Constant):
        return "None" if shape.value is None else f"a constant {type(shape.value).__name__}"
    if isinstance(shape, RuntimeList):
        return f"params['{shape.name}']"
    if isinstance(shape, Thing):
        return shape.name
    return {"bool": "a truth value", "int": "an int", "float": "a float", "text": "a text"}[shape]


def flat(shape: Shape) -> list[str]:
    """The kinds of all numbers in a type, in order; of what need not be held none."""
    if isinstance(shape, str):
        return [shape]
    return [kind for item in shape for kind in flat(item)] if isinstance(shape, tuple) else []


def codes(value: Value, shape: Any) -> list[str]:
    """C++ texts of all numbers in a value, each cast to its kind in ``shape``."""
    if isinstance(value, Number):
        return [cast(value, shape)]
    if isinstance(value, ItemList):
        return [code for item, kind in zip(value.items, shape, strict=True) for code in codes(item, kind)]
    return []


def rebuilt(shape: Shape, names: list[str]) -> Value:
    """The value of a type whose numbers are held by ``names``, in order."""
    if isinstance(shape, str):
        return Number(shape, names.pop(0))
    if isinstance(shape, tuple):
        return ItemList(tuple(rebuilt(item, names) for item in shape))
    return shape
