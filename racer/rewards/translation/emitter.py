"""The C++ lines emitted for a reward function: temporaries, checks, and what names stand for."""

from __future__ import annotations

import ast
from collections.abc import Callable
from typing import Any, TypeVar

from racer.rewards.translation.expression_values import (
    C_TYPES,
    Number,
    Outside,
    Thing,
    Value,
    codes,
    described,
    flat,
    rebuilt,
    shape_of,
)
from racer.rewards.translation.prelude import LOOP, UNBOUND
from racer.rewards.translation.program import Program

BUILTINS = (  # noqa: SIM905
    "abs all any bool divmod enumerate float int len list max min pow print range reversed round sum tuple zip str"
).split()


Made = TypeVar("Made")


class Emitting:
    """Lines of C++, and the names in them.

    Attributes:
        program: What all functions share.
        lines: Where lines go.
        slots: Types of the local variables.
        assigned: Local variables that have a value here, whatever way led here.
        flagged: Local variables that may be read before they have a value.
        local: Names of all local variables.
        overlay: Values of the variables of comprehensions.
        may_fail: Whether something may have failed since the last check.
    """

    program: Program
    lines: list[str]
    slots: dict[str, Any]
    assigned: set[str]
    flagged: set[str]
    local: set[str]
    overlay: list[dict[str, Value]]
    may_fail: bool
    parent: Any
    label: int

    # lines

    def emit(self, line: str) -> None:
        """Add a line."""
        self.lines.append(line)

    def at(self, node: ast.AST) -> str:
        """The arguments that pass the line to helpers, with a note that they may fail."""
        self.may_fail = True
        return str(16 * getattr(node, "lineno", 0))

    def check(self) -> None:
        """Leave the function where something failed."""
        if self.may_fail:
            self.emit("if (error) return {};")
            self.may_fail = False

    def captured(self, make: Callable[[], Made]) -> tuple[Made, list[str]]:
        """The result of ``make`` and the lines that it added, which are removed again."""
        before, self.lines = self.lines, []
        try:
            return make(), self.lines
        finally:
            self.lines = before

    def fresh(self) -> str:
        """A name of a temporary."""
        return f"t{self.program.number()}"

    def hold(self, value: Value) -> Value:
        """The same value, kept in temporaries that nothing changes."""
        shape = shape_of(value)
        names = []
        for kind, code in zip(flat(shape), codes(value, shape), strict=True):
            names.append(self.fresh())
            self.emit(f"const {C_TYPES[kind]} {names[-1]} = {code};")
        return value if isinstance(value, Number) and value.constant is not None else rebuilt(shape, names)

    def numeric(self, value: Value, node: ast.AST) -> Number:
        """A value that has to be a number."""
        if not isinstance(value, Number) or value.kind == "text":
            raise Outside(node, f"arithmetic with {described(shape_of(value))}")
        return value

    # expressions

    def expression(self, node: ast.expr) -> Value:
        """The value of an expression."""
        self.program.work(node)
        method = getattr(self, f"_{type(node).__name__}", None)
        if method is None:
            raise Outside(node, _TOLD.get(type(node).__name__, f"a {type(node).__name__}"))
        value: Value = method(node)
        return value

    def lookup(self, name: str, node: ast.AST) -> Value:
        """The value of a name."""
        for known in reversed(self.overlay):
            if name in known:
                return known[name]
        if name in self.local:
            shape = self.slots.get(name, "bool")
            if name not in self.assigned and flat(shape):
                self.flagged.add(name)
                self.emit(f"if (!{self.flag(name)}) py_fail({self.at(node)} + {UNBOUND});")
            return rebuilt(shape, self.variables(name, shape))
        if self.parent is not None:
            found: Value = self.parent.lookup(name, node)
            return found
        if name in self.program.names:
            known_value = self.program.names[name]
            if isinstance(known_value, Thing) and known_value.kind == "refused":
                raise Outside(node, known_value.name)
            return known_value
        if name in BUILTINS:
            return Thing("builtin", name)
        raise Outside(node, f"the name {name}")

    def is_own(self, name: str) -> bool:
        """Whether a name is a variable of this function, or of one around it."""
        own = name in self.local or any(name in known for known in self.overlay)
        return own or (self.parent is not None and bool(self.parent.is_own(name)))

    def constant(self, node: ast.expr) -> Any:
        """The value of a constant expression.

        Raises:
            Outside: It is none.
        """
        if any(isinstance(each, ast.Name) and self.is_own(each.id) for each in ast.walk(node)):
            raise Outside(node, "a value that is no constant")
        return self.program.constant(node)

    def variables(self, name: str, shape: Any) -> list[str]:
        """C++ names of a local variable's numbers."""
        end = name if name.isascii() else f"u{name.encode('unicode_escape').hex()}"
        if isinstance(shape, str):
            return [f"v{self.label}_{end}"]
        return [f"v{self.label}i{place}_{end}" for place in range(len(flat(shape)))]

    def flag(self, name: str) -> str:
        """C++ name of whether a local variable has a value."""
        return f"has_{self.variables(name, 'bool')[0]}"

    def round(self, node: ast.AST) -> str:
        """A line that counts how often loops go round."""
        return f"if (--rounds < 0) {{ py_fail({16 * getattr(node, 'lineno', 0)} + {LOOP}); return {{}}; }}"


_TOLD = {
    "DictComp": "a dictionary that is made when it runs",
    "SetComp": "a set",
    "Set": "a set",
    "Await": "await",
    "Yield": "yield",
    "NamedExpr": "an assignment inside an expression (:=)",
    "Starred": "a starred item",
    "Lambda": "a lambda in this place",
    "ListComp": "a list that grows",
    "GeneratorExp": "a generator in this place",
}
