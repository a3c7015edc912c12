"""Emission of C++: lines, variables, and the code of values."""

from __future__ import annotations

import ast
from collections.abc import Callable, Iterable
from typing import Any, TypeVar

from racer.rewards.translation.expression_values import (
    C_TYPES,
    Number,
    Outside,
    Value,
    described,
    flat,
    is_known,
    joined,
    kind_of,
    rebuilt,
    shape_of,
)

Made = TypeVar("Made")


class Emission:
    """Adds lines of C++.

    Attributes:
        program: What all functions share.
        lines: Where lines go.
        slots: Shapes of the local variables.
        assigned: Local variables that have a value here, whatever way led here.
        flagged: Local variables that may be read before they have a value.
        local: Names of all local variables.
        may_fail: Whether something may have failed since the last check.
    """

    program: Any
    parent: Any
    label: int
    lines: list[str]
    slots: dict[str, Value]
    assigned: set[str]
    flagged: set[str]
    local: set[str]
    may_fail: bool

    # lines

    def emit(self, *lines: str) -> None:
        """Add lines."""
        self.lines += lines

    def at(self, node: ast.AST, error: int = 0) -> str:
        """What says where an error is, and notes that there may be one."""
        self.may_fail = True
        return str(16 * getattr(node, "lineno", 0) + error)

    def check(self) -> None:
        """Leave the function where something failed."""
        if self.may_fail:
            self.emit("if (error) return;")
            self.may_fail = False

    def captured(self, make: Callable[[], Made]) -> tuple[Made, list[str]]:
        """The result of ``make`` and the lines that it added, which are removed again."""
        before, self.lines = self.lines, []
        try:
            return make(), self.lines
        finally:
            self.lines = before

    def variable(self, kind: str, code: str, const: str = "const ") -> str:
        """Name of a new variable with this value."""
        name = f"t{self.program.number()}"
        self.emit(f"{const}{C_TYPES[kind]} {name} = {code};")
        return name

    def variables(self, shape: Value, codes: Iterable[str] | None = None) -> list[str]:
        """Names of new variables for a shape, with these values or 0; they can be changed."""
        kinds = flat(shape)
        return [self.variable(*each, const="") for each in zip(kinds, codes or ["0"] * len(kinds), strict=True)]

    def hold(self, value: Value) -> Value:
        """The same value, kept in variables that nothing changes."""
        if is_known(value):
            return value
        shape = shape_of(value)
        return rebuilt(shape, map(self.variable, flat(shape), self.codes(value, shape)))

    def code(self, value: Value, kind: str) -> str:
        """C++ of a number or text as this kind."""
        if isinstance(value, Number):
            return value.code if value.kind == kind else f"({C_TYPES[kind]})({value.code})"
        if kind == "text":
            return str(self.program.texts.setdefault(value, len(self.program.texts)))
        if kind == "bool":
            return "true" if value else "false"
        text = f"{int(value)}LL" if kind == "int" else repr(float(value))
        text = {"nan": "(double)NAN", "inf": "(double)INFINITY", "-inf": "-(double)INFINITY"}.get(text, text)
        return text if text[0].isdigit() else f"({text})"

    def codes(self, value: Value, shape: Value) -> list[str]:
        """C++ of all numbers in a value, each as its kind in a shape."""
        if isinstance(shape, list | tuple):
            return [code for pair in zip(value, shape, strict=True) for code in self.codes(*pair)]
        return [self.code(value, shape.kind)] if isinstance(shape, Number) else []

    def kind(self, value: Value, node: ast.AST) -> str:
        """The kind of a value that has to be a number."""
        kind = kind_of(value)
        if kind in (None, "text"):
            raise Outside(node, f"arithmetic with {described(value)}")
        return kind or ""

    def join(self, one: Value, other: Value, node: ast.AST, message: str) -> Value:
        """The shape of a variable that holds both values."""
        try:
            return joined(shape_of(one), shape_of(other))
        except ValueError:
            raise Outside(node, message.format(described(one), described(other))) from None
