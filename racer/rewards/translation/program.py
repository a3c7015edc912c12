"""The program under translation: state shared by all functions of one file, and the names to which the file assigns values."""

from __future__ import annotations

import ast
import math
import operator
from collections.abc import Mapping, Sequence
from typing import Any

from racer.rewards.parameters import BY_NAME, NUMBER_COLUMNS, OBJECT_COLUMNS, OBJECT_COUNT
from racer.rewards.translation.expression_values import (
    C_TYPES,
    LONGEST_GROUP,
    Constant,
    ItemList,
    Number,
    Outside,
    RuntimeList,
    Thing,
    Value,
    number,
)

MODULES = ("math", "numpy")
"""Modules of which functions of numbers are translated."""
CONSTANTS: Mapping[str, float] = {
    "pi": math.pi,
    "e": math.e,
    "tau": math.tau,
    "inf": math.inf,
    "nan": math.nan,
}
_BINARY: Mapping[type[ast.operator], Any] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.FloorDiv: operator.floordiv,
    ast.Mod: operator.mod,
    ast.Pow: operator.pow,
}
_MOST_WORK = 50_000
"""Expressions that are translated at most, counted as often as they are visited."""


def folded(operation: ast.operator, one: Any, other: Any) -> Any:
    """The result of an operation of known numbers; None where it has none, or is too large to be worked out here."""
    if type(operation) not in _BINARY or max(abs(one), abs(other)) > 1e15:
        return None
    if isinstance(operation, ast.Pow) and abs(other) > 64:
        return None
    try:
        result = _BINARY[type(operation)](one, other)
    except ArithmeticError:
        return None
    fits = isinstance(result, bool | int | float) and (isinstance(result, float) or abs(result) < 2**62)
    return result if fits else None


class Program:
    """A file that is being translated.

    Args:
        tree: Its syntax tree.

    Attributes:
        names: What its names stand for.
        keys: The keys of ``params`` that are read.
        tables: C++ declarations of constant lists, by the constant's name.
        structs: Names of the C++ structs that functions return, by the kinds of their numbers.
        functions: C++ text of the functions that are called, in order.
        known: C++ name, type of the result and its C++ type of each function that was translated, by its node and the types of its arguments.
        running: The functions that are being translated, innermost last.
        notes: What is left out, a line each.
    """

    def __init__(self, tree: ast.Module) -> None:
        self.names: dict[str, Value] = {}
        self.keys: set[str] = set()
        self.tables: dict[str, tuple[str, str]] = {}
        self.structs: dict[tuple[str, ...], str] = {}
        self.functions: list[str] = []
        self.known: dict[Any, tuple[str, Any, str]] = {}
        self.running: list[ast.AST] = []
        self.notes: list[str] = []
        self._texts: dict[str, int] = {}
        self._constants: dict[str, str] = {}
        self._starred: set[str] = set()
        self._count = self._work = 0
        for statement in tree.body:
            _check_harmless(statement)
            self._define(statement)
        for node in ast.walk(tree):
            if isinstance(node, ast.Global):
                for name in node.names:
                    self.names[name] = Thing("refused", f"the global variable {name}, which keeps its value", node)

    def number(self) -> int:
        """A number that no other name has."""
        self._count += 1
        return self._count

    def work(self, node: ast.AST) -> None:
        """Count what is translated: functions that call functions many times over are not worked out for ever."""
        self._work += 1
        if self._work > _MOST_WORK:
            raise Outside(node, "a function that is too long with all that it calls")

    def note(self, line: int, text: str) -> None:
        """Remember what is left out."""
        note = f"line {line}: {text}"
        if note not in self.notes:
            self.notes.append(note)

    # values

    def wrap(self, value: Any, node: ast.AST | int) -> Value:
        """A constant of Python as a value."""
        if isinstance(value, str):
            return Number("text", str(self._texts.setdefault(value, len(self._texts))), value)
        if isinstance(value, bool | int | float):
            try:
                return number(value)
            except OverflowError as error:
                raise Outside(node, str(error)) from error
        if isinstance(value, list | tuple) and _count(value) <= LONGEST_GROUP:
            return ItemList(tuple(self.wrap(item, node) for item in value))
        if value is None or isinstance(value, list | tuple | dict):
            return Constant(value, self._constants.setdefault(repr(value), f"c{len(self._constants)}"))
        raise Outside(node, f"a constant of type {type(value).__name__}")

    def parameter(self, name: str) -> Value:
        """A key of ``params`` that there is."""
        found = BY_NAME[name]
        self.keys.add(name)
        if found.shape == "one":
            return Number(found.kind, f"p_{name}")
        if found.shape == "two":
            return ItemList((Number("int", f"p_{name}_0"), Number("int", f"p_{name}_1")))
        if found.shape == "waypoints":
            return RuntimeList(name, "count_waypoints", _point("py_waypoint({}, 0)", "py_waypoint({}, 1)"))
        first = OBJECT_COLUMNS[name]
        if found.points:
            return RuntimeList(
                name, "count_objects", _point(f"py_object({{}}, {first})", f"py_object({{}}, {first + 1})")
            )
        code = f"py_object({{}}, {first})"
        if found.kind == "bool":
            return RuntimeList(name, "count_objects", lambda index: Number("bool", f"({code.format(index)} != 0.0)"))
        return RuntimeList(name, "count_objects", lambda index: Number("float", code.format(index)))

    def prologue(self) -> list[str]:
        """C++ lines that read the keys that are used."""
        lines = []
        for name in sorted(self.keys & set(NUMBER_COLUMNS)):
            first, found = NUMBER_COLUMNS[name], BY_NAME[name]
            for place in range(found.width):
                cell = f"wp::index(race.numbers, world, {first + place})"
                read = f"({cell} != 0.0f)" if found.kind == "bool" else f"({C_TYPES[found.kind]}){cell}"
                end = f"_{place}" if found.shape == "two" else ""
                lines.append(f"const {C_TYPES[found.kind]} p_{name}{end} = {read};")
        if self.keys & set(OBJECT_COLUMNS):
            lines.append(f"const long long count_objects = (long long)wp::index(race.numbers, world, {OBJECT_COUNT});")
        return lines

    def struct(self, kinds: Sequence[str]) -> str:
        """Name of the C++ struct of these kinds."""
        return self.structs.setdefault(tuple(kinds), f"Result{len(self.structs)}")

    def table(self, constant: Constant, node: ast.AST) -> tuple[str, list[str]]:
        """C++ name of a constant list's array, and the kinds of its columns.

        Raises:
            Outside: Its rows differ in their length, or hold something else than numbers.
        """
        rows = [row if isinstance(row, list | tuple) else [row] for row in constant.value]
        width = len(rows[0]) if rows else 0
        if not width or any(len(row) != width for row in rows):
            raise Outside(node, "a constant list whose rows differ in length")
        if not all(isinstance(item, bool | int | float) and abs(item) < 2**53 for row in rows for item in row):
            raise Outside(node, "a constant list that holds more than numbers")
        kinds = []
        for column in zip(*rows, strict=True):
            types = {type(item) for item in column}
            kinds.append("bool" if types == {bool} else "int" if float not in types else "float")
        if constant.name not in self.tables:
            cells = ", ".join(number(float(item)).code for row in rows for item in row)
            name = f"table_{constant.name}"
            self.tables[constant.name] = (name, f"static const double {name}[] = {{{cells}}};")
        return self.tables[constant.name][0], kinds

    # names of the file

    def _define(self, statement: ast.stmt) -> None:
        if isinstance(statement, ast.FunctionDef):
            self._name(statement.name, Thing("function", statement.name, statement))
        elif isinstance(statement, ast.Import):
            for alias in statement.names:
                name = alias.asname or alias.name.partition(".")[0]
                module = alias.name if alias.asname else name
                self._name(name, Thing("module", module, statement))
        elif isinstance(statement, ast.ImportFrom):
            names = {alias.asname or alias.name: alias.name for alias in statement.names}
            if starred := "*" in names:
                if statement.module != "math":
                    raise Outside(statement, f"from {statement.module} import *")
                names = {name: name for name in vars(math) if not name.startswith("_")}
            for name, original in names.items():
                value: Value = Thing("builtin", f"{statement.module}.{original}", statement)
                if statement.module == "math" and original in CONSTANTS:
                    value = self.wrap(CONSTANTS[original], statement)
                self._name(name, value)
            self._starred |= set(names) if starred else set()
        elif isinstance(statement, ast.ClassDef):
            self._name(statement.name, Thing("refused", f"the class {statement.name}", statement))
        elif isinstance(statement, ast.Assign | ast.AnnAssign | ast.AugAssign):
            self._assign(statement)
        elif isinstance(statement, ast.If | ast.For | ast.While | ast.With | ast.Try | ast.Delete):
            for node in ast.walk(statement):
                if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store | ast.Del):
                    self._name(node.id, Thing("refused", f"{node.id}, which a statement of the module sets", statement))

    def _assign(self, statement: ast.Assign | ast.AnnAssign | ast.AugAssign) -> None:
        targets = statement.targets if isinstance(statement, ast.Assign) else [statement.target]
        if statement.value is None:
            return
        try:
            if isinstance(statement, ast.AugAssign):
                raise Outside(statement, "a module's variable that is changed")
            if isinstance(statement.value, ast.Lambda):
                value: Value = Thing("function", "lambda", statement.value)
            else:
                value = self.wrap(self.constant(statement.value), statement)
        except Outside as outside:
            value = Thing("refused", outside.reason, outside.line)
        for target in targets:
            names = target.elts if isinstance(target, ast.Tuple | ast.List) else [target]
            parts = (
                value.items
                if isinstance(target, ast.Tuple) and isinstance(value, ItemList) and len(value.items) == len(names)
                else [value] * len(names)
            )
            for name, part in zip(names, parts, strict=True):
                if isinstance(name, ast.Name):
                    kept = part if len(names) == 1 or part is not value else Thing("refused", name.id, statement)
                    self._name(name.id, kept)

    def _name(self, name: str, value: Value) -> None:
        if name in self.names and name not in self._starred:
            value = Thing("refused", f"{name}, which the module sets more than once", getattr(value, "node", None))
        self._starred.discard(name)
        self.names[name] = value

    def constant(self, node: ast.expr) -> Any:
        """The value of a constant expression.

        Raises:
            Outside: It is none.
        """
        if isinstance(node, ast.Constant) and (node.value is None or isinstance(node.value, str | bool | int | float)):
            return node.value
        if isinstance(node, ast.List | ast.Tuple) and not any(isinstance(each, ast.Starred) for each in node.elts):
            items = [self.constant(each) for each in node.elts]
            return items if isinstance(node, ast.List) else tuple(items)
        if isinstance(node, ast.Dict) and None not in node.keys:
            return {self._key(key): self.constant(each) for key, each in zip(node.keys, node.values, strict=True)}
        if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub | ast.UAdd):
            value = self.constant(node.operand)
            if isinstance(value, int | float):
                return -value if isinstance(node.op, ast.USub) else +value
        if isinstance(node, ast.BinOp):
            one, other = self.constant(node.left), self.constant(node.right)
            if isinstance(one, int | float) and isinstance(other, int | float):
                result = folded(node.op, one, other)
                if result is not None:
                    return result
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.attr in CONSTANTS:
            module = self.names.get(node.value.id)
            if isinstance(module, Thing) and module.kind == "module" and module.name in MODULES:
                return CONSTANTS[node.attr]
        if isinstance(node, ast.Name):
            known = self.names.get(node.id)
            if isinstance(known, Constant):
                return known.value
            if isinstance(known, Number) and known.constant is not None:
                return known.constant
            if isinstance(known, ItemList):
                return _plain(known)
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and len(node.args) == 1:
            module = self.names.get(node.func.value.id) if isinstance(node.func.value, ast.Name) else None
            if isinstance(module, Thing) and module.name == "math" and node.func.attr in ("radians", "degrees", "sqrt"):
                value = self.constant(node.args[0])
                if isinstance(value, int | float) and value >= 0:
                    return getattr(math, node.func.attr)(value)
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
            known = self.names.get(node.func.id)
            if isinstance(known, Thing) and known.kind == "refused":
                raise Outside(node, f"an object of {known.name}")
        raise Outside(node, "a value that is worked out when the module is imported")

    def _key(self, node: ast.expr | None) -> Any:
        key = self.constant(node) if node is not None else None
        if not all(isinstance(each, str | int | float) for each in (key if isinstance(key, tuple) else [key])):
            raise Outside(node or 0, "a dictionary whose keys are no constants")
        return key


def _check_harmless(statement: ast.stmt) -> None:
    """Refuse a statement of the module that may change a value: what is constant would be unknown."""
    if isinstance(statement, ast.FunctionDef | ast.ClassDef | ast.AsyncFunctionDef):
        return
    for node in ast.walk(statement):
        called = node.value if isinstance(node, ast.Expr) and isinstance(node.value, ast.Call) else None
        prints = called is not None and isinstance(called.func, ast.Name) and called.func.id == "print"
        stores = isinstance(node, ast.Subscript | ast.Attribute) and not isinstance(node.ctx, ast.Load)
        if stores or (called is not None and not prints):
            raise Outside(node, "a statement of the module that changes something")


def _plain(value: Value) -> Any:
    if isinstance(value, ItemList):
        return [_plain(item) for item in value.items]
    assert isinstance(value, Number)  # the groups of a module hold nothing else
    return value.constant


def _count(value: Any) -> int:
    """Numbers and texts in nested lists; more than any group has where something else is among them."""
    if isinstance(value, list | tuple):
        return sum(_count(item) for item in value)
    return 1 if isinstance(value, bool | int | float | str) else LONGEST_GROUP + 1


def _point(x: str, y: str) -> Any:
    return lambda index: ItemList((Number("float", x.format(index)), Number("float", y.format(index))))
