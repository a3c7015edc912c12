"""Expressions of a reward function in C++."""

from __future__ import annotations

import ast
import contextlib
from functools import partial
from typing import Any

from racer.rewards.parameters import BY_NAME
from racer.rewards.translation.expression_values import (
    C_TYPES,
    LONGEST_GROUP,
    ORDER,
    Constant,
    ItemList,
    Number,
    Outside,
    RuntimeList,
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
from racer.rewards.translation.items import Items
from racer.rewards.translation.prelude import KEY
from racer.rewards.translation.program import CONSTANTS, MODULES, folded

_COMPARED = {ast.Lt: "<", ast.LtE: "<=", ast.Gt: ">", ast.GtE: ">=", ast.Eq: "==", ast.NotEq: "!="}
_WHOLE = {ast.Add: "py_iadd", ast.Sub: "py_isub", ast.Mult: "py_imul", ast.FloorDiv: "py_idiv", ast.Mod: "py_imod"}
_BITS = {ast.BitAnd: "&", ast.BitOr: "|", ast.BitXor: "^"}
_MOST_POWER = 64


class Expressions(Items):
    """Translates expressions into C++ expressions, and into lines before them where one does not do."""

    def _Constant(self, node: ast.Constant) -> Value:
        return self.program.wrap(node.value, node)

    def _JoinedStr(self, node: ast.JoinedStr) -> Value:
        raise Outside(node, "a text that is made when it runs")

    def _Name(self, node: ast.Name) -> Value:
        return self.lookup(node.id, node)

    def _Tuple(self, node: ast.Tuple | ast.List) -> Value:
        with contextlib.suppress(Outside):
            return self.program.wrap(self.constant(node), node)
        if any(isinstance(each, ast.Starred) for each in node.elts):
            raise Outside(node, "a list with a starred item")
        if len(node.elts) > LONGEST_GROUP:
            raise Outside(node, f"a list of more than {LONGEST_GROUP} items that are no constants")
        return ItemList(tuple(self.expression(each) for each in node.elts))

    _List = _Tuple

    def _Dict(self, node: ast.Dict) -> Value:
        return self.program.wrap(self.constant(node), node)

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
        if isinstance(operation, ast.Add) and isinstance(left, ItemList) and isinstance(right, ItemList):
            return ItemList((*left.items, *right.items))
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
                sign = {ast.Add: "+", ast.Sub: "-", ast.Mult: "*"}[type(operation)]
                return Number("float", f"({a} {sign} {b})")
            if isinstance(operation, ast.Div) and other.constant:
                return Number("float", f"({a} / {b})")
            name = {ast.Div: "py_div", ast.FloorDiv: "py_floordiv", ast.Mod: "py_mod"}[type(operation)]
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
        if whole and exponent.constant > _MOST_POWER:
            raise Outside(node, f"an int to a power of more than {_MOST_POWER}")
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
        if isinstance(value, ItemList):
            return number(bool(value.items))
        if isinstance(value, Constant):
            return number(bool(value.value))
        if isinstance(value, RuntimeList):
            return Number("bool", f"({value.length} > 0)")
        return number(True)

    def condition(self, node: ast.expr) -> Number:
        """Whether an expression is true; the later parts of ``and`` and ``or`` are worked out only where they count."""
        if not isinstance(node, ast.BoolOp):
            return self.truth(self.expression(node), node)
        sign, decides = ("&&", False) if isinstance(node.op, ast.And) else ("||", True)
        parts: list[str] = []
        for place, each in enumerate(node.values):
            value, lines = self.captured(partial(self.condition, each))
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
            self.captured(partial(self.expression, branch)) for branch in (node.body, node.orelse)
        )
        shape = joined(shape_of(one), shape_of(other))
        if shape is None:
            raise Outside(node, f"a value that is {described(shape_of(one))} or {described(shape_of(other))}")
        if isinstance(shape, str) and not before and not otherwise:
            return Number(shape, f"({test.code} ? {codes(one, shape)[0]} : {codes(other, shape)[0]})")
        names = [self.fresh() for _ in flat(shape)]
        self.lines += [f"{C_TYPES[kind]} {name} = 0;" for kind, name in zip(flat(shape), names, strict=True)]
        for opening, lines, value in (
            (f"if {parenthesised(test.code)} {{", before, one),
            ("} else {", otherwise, other),
        ):
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
        if isinstance(operation, ast.Eq) and isinstance(one, ItemList) and isinstance(other, ItemList):
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
            other = ItemList(tuple(self.program.wrap(key, node) for key in other.value))
        held = self.hold(one)
        if isinstance(other, ItemList):
            parts = [self.compared(ast.Eq(), held, item, node).code for item in other.items]
            return Number("bool", f"({' || '.join(parts) or 'false'})")
        found = self.fresh()
        self.emit(f"bool {found} = false;")
        self.each(
            other,
            node,
            lambda item: self.emit(
                f"if {parenthesised(self.compared(ast.Eq(), held, item, node).code)} {{ {found} = true; break; }}"
            ),
        )
        return Number("bool", found)

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


def _wrapped(kind: str, code: str, lines: list[str]) -> str:
    """An expression that works out lines before."""
    return f"[&]() -> {C_TYPES[kind]} {{ {' '.join(lines)} return {code}; }}()" if lines else code
