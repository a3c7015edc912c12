"""Expressions of a reward function in C++."""

from __future__ import annotations

import ast
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from shared_store.wording import nearest
from worker.racer.rewards.parameters import BY_NAME
from worker.racer.rewards.translation.prelude import KEY, LOOP, UNBOUND
from worker.racer.rewards.translation.program import CONSTANTS, MODULES, Program, folded
from worker.racer.rewards.translation.values import (
    C_TYPES,
    LONGEST_GROUP,
    ORDER,
    Constant,
    Group,
    Number,
    Outside,
    Rows,
    Thing,
    Value,
    cast,
    codes,
    described,
    flat,
    joined,
    number,
    parenthesised,
    rebuilt,
    shape_of,
)

BUILTINS = (
    "abs all any bool divmod enumerate float int len list max min pow print range reversed round sum tuple zip str".split()
)
_COMPARED = {ast.Lt: "<", ast.LtE: "<=", ast.Gt: ">", ast.GtE: ">=", ast.Eq: "==", ast.NotEq: "!="}
_WHOLE = {ast.Add: "py_iadd", ast.Sub: "py_isub", ast.Mult: "py_imul", ast.FloorDiv: "py_idiv", ast.Mod: "py_imod"}
_BITS = {ast.BitAnd: "&", ast.BitOr: "|", ast.BitXor: "^"}


@dataclass(frozen=True)
class Iterated:
    """Something to go through.

    Attributes:
        length: C++ expression of how many items it has.
        item: From an index that is valid to the item.
        known: How many, where that is known.
    """

    length: str
    item: Callable[[str], Value]
    known: int | None = None


class Expressions:
    """Translates expressions into C++ expressions, and into lines before them where one does not do.

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
        """What helpers are told of the line, with a note that they may fail."""
        self.may_fail = True
        return str(16 * getattr(node, "lineno", 0))

    def check(self) -> None:
        """Leave the function where something failed."""
        if self.may_fail:
            self.emit("if (error) return {};")
            self.may_fail = False

    def captured(self, make: Callable[[], Any]) -> tuple[Any, list[str]]:
        """What ``make`` gives, and the lines that it added, which are taken away again."""
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

    def _Constant(self, node: ast.Constant) -> Value:
        return self.program.wrap(node.value, node)

    def _JoinedStr(self, node: ast.JoinedStr) -> Value:
        raise Outside(node, "a text that is made when it runs")

    def _Name(self, node: ast.Name) -> Value:
        return self.lookup(node.id, node)

    def lookup(self, name: str, node: ast.AST) -> Value:
        """What a name stands for."""
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

    def variables(self, name: str, shape: Any) -> list[str]:
        """C++ names of a local variable's numbers."""
        stem = f"v{self.label}_{name if name.isascii() else name.encode('unicode_escape').hex()}"
        kinds = flat(shape)
        return [stem] if isinstance(shape, str) else [f"{stem}_{place}" for place in range(len(kinds))]

    def flag(self, name: str) -> str:
        """C++ name of whether a local variable has a value."""
        return f"has_{self.variables(name, 'bool')[0]}"

    def _Tuple(self, node: ast.Tuple | ast.List) -> Value:
        try:
            constant = self.program.constant(node)
        except Outside:
            pass
        else:
            if not any(isinstance(each, ast.Name) and each.id in self.local for each in ast.walk(node)):
                return self.program.wrap(constant, node)
        if any(isinstance(each, ast.Starred) for each in node.elts):
            raise Outside(node, "a list with a starred item")
        if len(node.elts) > LONGEST_GROUP:
            raise Outside(node, f"a list of more than {LONGEST_GROUP} items that are no constants")
        return Group(tuple(self.expression(each) for each in node.elts))

    _List = _Tuple

    def _Dict(self, node: ast.Dict) -> Value:
        return self.program.wrap(self.program.constant(node), node)

    def _Attribute(self, node: ast.Attribute) -> Value:
        base = self.expression(node.value)
        if isinstance(base, Thing) and base.kind == "module":
            if base.name in MODULES and node.attr in CONSTANTS:
                return number(CONSTANTS[node.attr])
            if base.name == "numpy" and node.attr == "linalg":
                return Thing("module", "numpy.linalg", node)
            return Thing("builtin", f"{base.name}.{node.attr}", node)
        raise Outside(node, f"the attribute {node.attr}")

    def _UnaryOp(self, node: ast.UnaryOp) -> Value:
        if isinstance(node.op, ast.Not):
            value = self.condition(node.operand)
            return Number("bool", f"(!{value.code})", None if value.constant is None else not value.constant)
        value = self.numeric(self.expression(node.operand), node)
        kind = "int" if value.kind == "bool" else value.kind
        if isinstance(node.op, ast.Invert):
            if kind != "int":
                raise Outside(node, "~ of a float")
            return Number("int", f"(~{cast(value, 'int')})")
        if value.constant is not None:
            return number(-value.constant if isinstance(node.op, ast.USub) else +value.constant)
        return Number(kind, f"({'-' if isinstance(node.op, ast.USub) else ''}{cast(value, kind)})")

    def _BinOp(self, node: ast.BinOp) -> Value:
        return self.binary(node.op, self.expression(node.left), self.expression(node.right), node)

    def binary(self, operation: ast.operator, left: Value, right: Value, node: ast.AST) -> Value:
        """An operation of two numbers."""
        if isinstance(operation, ast.Add) and isinstance(left, Group) and isinstance(right, Group):
            return Group((*left.items, *right.items))
        one, other = self.numeric(left, node), self.numeric(right, node)
        if one.constant is not None and other.constant is not None:
            result = folded(operation, one.constant, other.constant)
            if result is not None:
                return number(result)
        whole = "float" not in (one.kind, other.kind)
        if type(operation) in _BITS or isinstance(operation, ast.LShift | ast.RShift):
            return self._bits(operation, one, other, whole, node)
        if isinstance(operation, ast.Pow):
            return self.power(one, other, node)
        if isinstance(operation, ast.MatMult):
            raise Outside(node, "a product of matrices")
        if isinstance(operation, ast.Div) or not whole:
            a, b = cast(one, "float"), cast(other, "float")
            if isinstance(operation, ast.Add | ast.Sub | ast.Mult):
                sign = {ast.Add: "+", ast.Sub: "-", ast.Mult: "*"}[type(operation)]  # type: ignore[index]
                return Number("float", f"({a} {sign} {b})")
            if isinstance(operation, ast.Div) and other.constant:
                return Number("float", f"({a} / {b})")
            name = {ast.Div: "py_div", ast.FloorDiv: "py_floordiv", ast.Mod: "py_mod"}[type(operation)]  # type: ignore[index]
            return Number("float", f"{name}({a}, {b}, {self.at(node)})")
        return Number("int", f"{_WHOLE[type(operation)]}({cast(one, 'int')}, {cast(other, 'int')}, {self.at(node)})")

    def _bits(self, operation: ast.operator, one: Number, other: Number, whole: bool, node: ast.AST) -> Number:
        if not whole or type(operation) not in _BITS:
            raise Outside(node, "an operation on the bits of a number")
        sign, kind = _BITS[type(operation)], "bool" if one.kind == other.kind == "bool" else "int"
        if kind == "bool" and sign == "^":
            return Number("bool", f"({one.code} != {other.code})")
        return Number(kind, f"(({C_TYPES[kind]})({cast(one, kind)} {sign} {cast(other, kind)}))")

    def power(self, base: Number, exponent: Number, node: ast.AST) -> Number:
        """``base ** exponent``: an int where both are and the exponent is known and not negative, else a float."""
        whole = "float" not in (base.kind, exponent.kind)
        if whole and exponent.constant is None:
            raise Outside(node, "an int to the power of an int that is not known")
        if whole and exponent.constant >= 0:
            return Number("int", f"py_ipow({cast(base, 'int')}, {cast(exponent, 'int')}, {self.at(node)})")
        return Number("float", f"py_pow({cast(base, 'float')}, {cast(exponent, 'float')}, {self.at(node)})")

    # truth

    def truth(self, value: Value, node: ast.AST) -> Number:
        """Whether a value is true."""
        if isinstance(value, Number):
            if value.constant is not None:
                return number(bool(value.constant))
            if value.kind == "text":
                raise Outside(node, "a text as a condition")
            return value if value.kind == "bool" else Number("bool", f"({value.code} != 0)")
        if isinstance(value, Group):
            return number(bool(value.items))
        if isinstance(value, Constant):
            return number(bool(value.value))
        if isinstance(value, Rows):
            return Number("bool", f"({value.length} > 0)")
        return number(True)

    def condition(self, node: ast.expr) -> Number:
        """Whether an expression is true; the later parts of ``and`` and ``or`` are worked out only where they count."""
        if not isinstance(node, ast.BoolOp):
            return self.truth(self.expression(node), node)
        sign, decides = ("&&", False) if isinstance(node.op, ast.And) else ("||", True)
        parts: list[str] = []
        for place, each in enumerate(node.values):
            value, lines = self.captured(lambda each=each: self.condition(each))  # type: ignore[misc]
            if value.constant is not None and not lines:
                if value.constant == decides:
                    if not parts:
                        return value
                    parts.append(value.code)
                    break
                continue
            if lines and place == 0:
                self.lines += lines
                lines = []
            parts.append(_wrapped("bool", value.code, lines))
        return Number("bool", f"({f' {sign} '.join(parts)})") if parts else number(not decides)

    def _BoolOp(self, node: ast.BoolOp) -> Value:
        values, lines = self.captured(lambda: [self.expression(each) for each in node.values])
        if all(isinstance(value, Number) and value.kind == "bool" for value in values):
            return self.condition(node)
        del lines
        wanted: Any = shape_of(values[0])
        for value in values[1:]:
            wanted = joined(wanted, shape_of(value))
        if wanted not in ORDER:
            raise Outside(node, "and / or of values of several types")
        name, decides = self.fresh(), "" if isinstance(node.op, ast.And) else "!"
        self.emit(f"{C_TYPES[wanted]} {name} = {cast(self.numeric(self.expression(node.values[0]), node), wanted)};")
        for each in node.values[1:]:
            self.emit(f"if ({decides}({name} != 0)) {{")
            self.emit(f"{name} = {cast(self.numeric(self.expression(each), node), wanted)};")
        self.lines += ["}"] * (len(node.values) - 1)
        return Number(wanted, name)

    def _IfExp(self, node: ast.IfExp) -> Value:
        test = self.condition(node.test)
        if test.constant is not None:
            return self.expression(node.body if test.constant else node.orelse)
        (one, before), (other, otherwise) = (
            self.captured(lambda branch=branch: self.expression(branch))  # type: ignore[misc]
            for branch in (node.body, node.orelse)
        )
        shape = joined(shape_of(one), shape_of(other))
        if shape is None:
            raise Outside(node, f"a value that is {described(shape_of(one))} or {described(shape_of(other))}")
        if isinstance(shape, str) and not before and not otherwise:
            return Number(shape, f"({test.code} ? {cast(one, shape)} : {cast(other, shape)})")
        names = [self.fresh() for _ in flat(shape)]
        self.lines += [f"{C_TYPES[kind]} {name} = 0;" for kind, name in zip(flat(shape), names, strict=True)]
        for opening, lines, value in ((f"if {parenthesised(test.code)} {{", before, one), ("} else {", otherwise, other)):
            self.lines += [opening, *lines]
            self.lines += [f"{name} = {code};" for name, code in zip(names, codes(value, shape), strict=True)]
        self.emit("}")
        return rebuilt(shape, list(names))

    def _Compare(self, node: ast.Compare) -> Value:
        values = [self.expression(node.left), *map(self.expression, node.comparators)]
        if len(values) > 2:
            values = [self.hold(value) for value in values]
        pairs = zip(node.ops, values, values[1:], strict=False)
        found = [self.compared(operation, one, other, node) for operation, one, other in pairs]
        if any(each.constant is False for each in found):
            return number(False)
        if all(each.constant is True for each in found):
            return number(True)
        return found[0] if len(found) == 1 else Number("bool", f"({' && '.join(each.code for each in found)})")

    def compared(self, operation: ast.cmpop, one: Value, other: Value, node: ast.AST) -> Number:
        """A comparison of two values."""
        if isinstance(operation, ast.NotIn | ast.IsNot | ast.NotEq):
            inverse = {ast.NotIn: ast.In, ast.IsNot: ast.Is, ast.NotEq: ast.Eq}[type(operation)]
            same = self.compared(inverse(), one, other, node)
            return Number("bool", f"(!{same.code})", None if same.constant is None else not same.constant)
        if isinstance(operation, ast.In):
            return self._contained(one, other, node)
        if isinstance(operation, ast.Is):
            if isinstance(one, Constant) or isinstance(other, Constant):
                return number(one == other)
            if not (isinstance(one, Number) and isinstance(other, Number) and one.kind == other.kind == "bool"):
                raise Outside(node, "is with anything but None, True or False")
            operation = ast.Eq()
        if isinstance(operation, ast.Eq) and isinstance(one, Group) and isinstance(other, Group):
            if len(one.items) != len(other.items):
                return number(False)
            parts = [self.compared(operation, *pair, node) for pair in zip(one.items, other.items, strict=True)]
            return Number("bool", f"({' && '.join(part.code for part in parts) or 'true'})")
        if not isinstance(one, Number) or not isinstance(other, Number):
            raise Outside(node, f"a comparison of {described(shape_of(one))} with {described(shape_of(other))}")
        if one.constant is not None and other.constant is not None and isinstance(operation, ast.Eq):
            return number(one.constant == other.constant)
        if "text" in (one.kind, other.kind):
            if not isinstance(operation, ast.Eq):
                raise Outside(node, "an order of texts")
            if one.kind != other.kind:
                return number(False)
        kind = joined(one.kind, other.kind)
        return Number("bool", f"({cast(one, kind)} {_COMPARED[type(operation)]} {cast(other, kind)})")

    def _contained(self, one: Value, other: Value, node: ast.AST) -> Number:
        if isinstance(other, Thing) and other.kind == "params" and isinstance(one, Number) and one.kind == "text":
            return number(one.constant in BY_NAME)
        if isinstance(other, Constant) and isinstance(other.value, dict):
            other = Group(tuple(self.program.wrap(key, node) for key in other.value))
        held = self.hold(one)
        if isinstance(other, Group):
            parts = [self.compared(ast.Eq(), held, item, node).code for item in other.items]
            return Number("bool", f"({' || '.join(parts) or 'false'})")
        found = self.fresh()
        self.emit(f"bool {found} = false;")
        self.each(
            other,
            node,
            lambda item: self.emit(f"if {parenthesised(self.compared(ast.Eq(), held, item, node).code)} {{ {found} = true; break; }}"),
        )
        return Number("bool", found)

    # items

    def _Subscript(self, node: ast.Subscript) -> Value:
        base = self.expression(node.value)
        if isinstance(node.slice, ast.Slice):
            return self._slice(base, node)
        return self.item(base, self.expression(node.slice), node)

    def item(self, base: Value, index: Value, node: ast.AST) -> Value:
        """``base[index]``."""
        if isinstance(base, Thing) and base.kind == "params":
            return self.key(index, node)
        known = index.constant if isinstance(index, Number) else None
        if isinstance(base, Constant) and isinstance(base.value, dict):
            return self._entry(base.value, index, node)
        index = self.numeric(index, node)
        if index.kind == "float":
            raise Outside(node, "an index that is a float")
        if isinstance(base, Constant) and isinstance(base.value, list | tuple):
            if known is not None and -len(base.value) <= known < len(base.value):
                return self.program.wrap(base.value[known], node)
            return self._cells(base, f"py_index({cast(index, 'int')}, {len(base.value)}, {self.at(node)})", node)
        if isinstance(base, Group):
            if known is not None and -len(base.items) <= known < len(base.items):
                return base.items[known]
            place = self.fresh()
            self.emit(f"const long long {place} = py_index({cast(index, 'int')}, {len(base.items)}, {self.at(node)});")
            return self.chosen(base.items, place, node)
        if isinstance(base, Rows):
            place = self.fresh()
            self.emit(f"const long long {place} = py_index({cast(index, 'int')}, {base.length}, {self.at(node)});")
            return base.row(place)
        raise Outside(node, f"an item of {described(shape_of(base))}")

    def key(self, index: Value, node: ast.AST) -> Value:
        """``params[index]``."""
        name = index.constant if isinstance(index, Number) else None
        if not isinstance(name, str):
            raise Outside(node, "a key of params that is not known")
        if name not in BY_NAME:
            raise Outside(node, f"params has no key {name!r} ({nearest(name, BY_NAME)})")
        return self.program.parameter(name)

    def _entry(self, entries: dict[Any, Any], index: Value, node: ast.AST) -> Value:
        """An entry of a constant dictionary."""
        if isinstance(index, Number) and index.constant is not None:
            if index.constant not in entries:
                raise Outside(node, f"a dictionary without the key {index.constant!r}")
            return self.program.wrap(entries[index.constant], node)
        if len(entries) > 4 * LONGEST_GROUP:
            raise Outside(node, "a long dictionary whose key is not known")
        held, place = self.hold(index), self.fresh()
        self.emit(f"long long {place} = -1;")
        for count, key in enumerate(entries):
            same = self.compared(ast.Eq(), held, self.program.wrap(key, node), node)
            self.emit(f"if {parenthesised(same.code)} {place} = {count};")
        self.emit(f"if ({place} < 0) py_fail({self.at(node)} + {KEY});")
        return self.chosen(tuple(self.program.wrap(value, node) for value in entries.values()), place, node)

    def chosen(self, items: tuple[Value, ...], place: str, node: ast.AST) -> Value:
        """One of several values, by a number that is known when it runs."""
        if not items:
            return number(0)
        shape = shape_of(items[0])
        for item in items[1:]:
            shape = joined(shape, shape_of(item))
        if shape is None or not flat(shape):
            raise Outside(node, "an item of a list whose items have several types")
        rows = [codes(item, shape) for item in items]
        names = []
        for kind, column in zip(flat(shape), zip(*rows, strict=True), strict=True):
            names.append(self.fresh())
            chain = "".join(f"{place} == {count} ? {code} : " for count, code in enumerate(column[:-1])) + column[-1]
            self.emit(f"const {C_TYPES[kind]} {names[-1]} = {chain};")
        return rebuilt(shape, names)

    def _cells(self, base: Constant, index: str, node: ast.AST) -> Value:
        """A row of a constant list, by a number that is known when it runs."""
        name, kinds = self.program.table(base, node)
        place = self.fresh()
        self.emit(f"const long long {place} = {index};")
        cells = tuple(
            Number(kind, f"({C_TYPES[kind]}){name}[{len(kinds)} * {place} + {column}]")
            for column, kind in enumerate(kinds)
        )
        return Group(cells) if isinstance(base.value[0], list | tuple) else cells[0]

    def _slice(self, base: Value, node: ast.Subscript) -> Value:
        assert isinstance(node.slice, ast.Slice)
        bounds: list[int | None] = []
        for each in (node.slice.lower, node.slice.upper, node.slice.step):
            value = self.expression(each) if each is not None else None
            if value is not None and (not isinstance(value, Number) or not isinstance(value.constant, int)):
                raise Outside(node, "a slice whose bounds are not known")
            bounds.append(None if value is None else value.constant)
        if isinstance(base, Group):
            return Group(base.items[slice(*bounds)])
        if isinstance(base, Constant) and isinstance(base.value, list | tuple) and bounds[2] != 0:
            return self.program.wrap(base.value[slice(*bounds)], node)
        raise Outside(node, f"a slice of {described(shape_of(base))}")

    # loops

    def iterated(self, value: Value, node: ast.AST) -> Iterated:
        """What a loop goes through."""
        if isinstance(value, Constant) and isinstance(value.value, dict):
            value = Group(tuple(self.program.wrap(key, node) for key in value.value))
        if isinstance(value, Group):
            held = self.hold(value)
            assert isinstance(held, Group)
            return Iterated(str(len(held.items)), lambda index: self.chosen(held.items, index, node), len(held.items))
        if isinstance(value, Constant) and isinstance(value.value, list | tuple):
            constant = value
            return Iterated(
                str(len(value.value)), lambda index: self._cells(constant, index, node), len(value.value)
            )
        if isinstance(value, Rows):
            return Iterated(value.length, value.row)
        if isinstance(value, Thing) and isinstance(value.scope, Iterated):
            return value.scope
        raise Outside(node, f"a loop over {described(shape_of(value))}")

    def each(self, value: Value, node: ast.AST, body: Callable[[Value], None]) -> None:
        """A loop: ``body`` adds the lines that use an item."""
        found = self.iterated(value, node)
        count, index = self.fresh(), self.fresh()
        self.emit(f"const long long {count} = {found.length};")
        self.check()
        self.emit(f"for (long long {index} = 0; {index} < {count}; ++{index}) {{")
        self.emit(self.round(node))
        body(found.item(index))
        self.check()
        self.emit("}")

    def round(self, node: ast.AST) -> str:
        """A line that counts how often loops go round."""
        return f"if (--rounds < 0) {{ py_fail({16 * getattr(node, 'lineno', 0)} + {LOOP}); return {{}}; }}"


def _wrapped(kind: str, code: str, lines: list[str]) -> str:
    """An expression that works out lines before."""
    return f"[&]() -> {C_TYPES[kind]} {{ {' '.join(lines)} return {code}; }}()" if lines else code


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
