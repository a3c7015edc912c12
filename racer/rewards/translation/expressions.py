"""Expressions of a reward function in C++, and the lines before them where one expression does not do."""

from __future__ import annotations

import ast
import operator
from collections.abc import Callable, Iterable
from functools import partial
from typing import Any

from racer.rewards.parameters import BY_NAME, OBJECT_COLUMNS
from racer.rewards.translation.emission import Emission
from racer.rewards.translation.expression_values import (
    C_TYPES,
    KINDS,
    LONGEST_GROUP,
    PARAMS,
    Known,
    Number,
    Outside,
    Series,
    Value,
    described,
    flat,
    is_known,
    is_table,
    joined,
    kind_of,
    rebuilt,
    shape_of,
)
from racer.rewards.translation.prelude import CONSTANTS, FUNCTIONS, KEY, LOOP, UNBOUND
from shared_store.contract.error_text import nearest

_ORDER: dict[type[ast.cmpop], tuple[Any, str]] = {
    ast.Lt: (operator.lt, "<"),
    ast.LtE: (operator.le, "<="),
    ast.Gt: (operator.gt, ">"),
    ast.GtE: (operator.ge, ">="),
    ast.Eq: (operator.eq, "=="),
}
_INVERSE: dict[type[ast.cmpop], type[ast.cmpop]] = {ast.NotIn: ast.In, ast.IsNot: ast.Is, ast.NotEq: ast.Eq}
_ARITHMETIC: dict[type[ast.operator], tuple[Any, str, str]] = {
    ast.Add: (operator.add, "py_iadd({}, {}, {at})", "({} + {})"),
    ast.Sub: (operator.sub, "py_isub({}, {}, {at})", "({} - {})"),
    ast.Mult: (operator.mul, "py_imul({}, {}, {at})", "({} * {})"),
    ast.Div: (operator.truediv, "", "py_div({}, {}, {at})"),
    ast.FloorDiv: (operator.floordiv, "py_idiv({}, {}, {at})", "py_floordiv({}, {}, {at})"),
    ast.Mod: (operator.mod, "py_imod({}, {}, {at})", "py_mod({}, {}, {at})"),
    ast.Pow: (operator.pow, "py_ipow({}, {}, {at})", "py_pow({}, {}, {at})"),
}
"""Of each operator: Python's function, and C++ for two ints and for two floats."""
_BITS = {ast.BitAnd: "&", ast.BitOr: "|", ast.BitXor: "^"}
_MOST_POWER = 64
_LONGEST_LIST = 100_000


class Expressions(Emission):
    """Translates expressions."""

    # names and constants

    def expression(self, node: ast.expr) -> Value:
        """The value of an expression."""
        method = getattr(self, f"_{type(node).__name__}", None)
        if method is None:
            raise Outside(node, _REFUSED.get(type(node).__name__, f"a {type(node).__name__}"))
        return method(node)

    def _Constant(self, node: ast.Constant) -> Value:
        if not is_known(node.value) or not fits(node.value):
            raise Outside(
                node, "a number beyond 64 bit" if isinstance(node.value, int) else "a constant that is not a number"
            )
        return node.value

    def _Name(self, node: ast.Name) -> Value:
        return self.lookup(node.id, node)

    def lookup(self, name: str, node: ast.AST) -> Value:
        """The value of a name."""
        if name not in self.local:
            return self.parent.lookup(name, node)
        shape = self.slots.get(name, Number("bool"))
        if name not in self.assigned and flat(shape):
            self.flagged.add(name)
            self.emit(f"if (!{self.flag(name)}) py_fail({self.at(node, UNBOUND)});")
        return rebuilt(shape, iter(self.places(name, shape)))

    def places(self, name: str, shape: Value) -> list[str]:
        """C++ names of a local variable's numbers."""
        end = name if name.isascii() else f"u{name.encode('unicode_escape').hex()}"
        parts = [""] if isinstance(shape, Number) else [f"i{place}" for place in range(len(flat(shape)))]
        return [f"v{self.label}{part}_{end}" for part in parts]

    def flag(self, name: str) -> str:
        """C++ name of whether a local variable has a value."""
        return f"has_{self.places(name, Number('bool'))[0]}"

    def _List(self, node: ast.List | ast.Tuple) -> Value:
        items = (list if isinstance(node, ast.List) else tuple)(map(self.expression, node.elts))
        if len(items) > LONGEST_GROUP and not is_known(items):
            raise Outside(node, f"a list of more than {LONGEST_GROUP} items that are not constant")
        return items

    _Tuple = _List

    def _Dict(self, node: ast.Dict) -> Value:
        keys = [... if key is None else self.expression(key) for key in node.keys]
        if not all(map(_is_key, keys)):
            raise Outside(node, "a dictionary whose keys are not constant")
        values = [self.expression(each) for each in node.values]
        if not is_known(values):
            raise Outside(node, "a dictionary that is made when it runs")
        return dict(zip(keys, values, strict=True))

    def _Attribute(self, node: ast.Attribute) -> Value:
        base = self.expression(node.value)
        if not isinstance(base, Known) or base.kind != "module":
            raise Outside(node, f"the attribute {node.attr}")
        if base.name in FUNCTIONS and node.attr in CONSTANTS:
            return CONSTANTS[node.attr]
        return Known("module" if node.attr == "linalg" else "builtin", f"{base.name}.{node.attr}")

    # arithmetic

    def _UnaryOp(self, node: ast.UnaryOp) -> Value:
        if isinstance(node.op, ast.Not):
            return _negated(self.condition(node.operand))
        value = self.expression(node.operand)
        kind = "float" if self.kind(value, node) == "float" else "int"
        if isinstance(node.op, ast.Invert) and kind != "int":
            raise Outside(node, "~ of a float")
        if is_known(value):
            return ~value if isinstance(node.op, ast.Invert) else -value if isinstance(node.op, ast.USub) else +value
        sign = {ast.Invert: "~", ast.USub: "-", ast.UAdd: ""}[type(node.op)]
        return Number(kind, f"({sign}{self.code(value, kind)})")

    def _BinOp(self, node: ast.BinOp) -> Value:
        return self.binary(node.op, self.expression(node.left), self.expression(node.right), node)

    def binary(self, operation: ast.operator, left: Value, right: Value, node: ast.AST) -> Value:
        """An operation of two numbers, or of two lists or tuples."""
        if isinstance(operation, ast.Add) and isinstance(left, list | tuple) and type(left) is type(right):
            if len(left) + len(right) > _LONGEST_LIST:
                raise Outside(node, f"a list of more than {_LONGEST_LIST:,} items")
            return type(left)([*left, *right])
        kinds = [self.kind(each, node) for each in (left, right)]
        kind = "float" if "float" in kinds or isinstance(operation, ast.Div) else "int"
        if type(operation) in _BITS and kind == "int":
            kind = "bool" if kinds == ["bool", "bool"] else "int"
            code = f" {_BITS[type(operation)]} ".join(self.code(each, kind) for each in (left, right))
            return Number(kind, f"(({C_TYPES[kind]})({code}))")
        if type(operation) not in _ARITHMETIC:
            is_product = isinstance(operation, ast.MatMult)
            raise Outside(node, "a product of matrices" if is_product else "an operation on the bits of a number")
        compute, for_ints, for_floats = _ARITHMETIC[type(operation)]
        if is_known([left, right]) and (result := _computed(compute, left, right)) is not None:
            return result
        if isinstance(operation, ast.Pow) and kind == "int":
            if not is_known(right):
                raise Outside(node, "an int to the power of an int that is not known")
            if right > _MOST_POWER:
                raise Outside(node, f"an int to a power of more than {_MOST_POWER}")
            kind = "int" if right >= 0 else "float"
        if isinstance(operation, ast.Div) and is_known(right) and right:
            for_floats = "({} / {})"
        template = for_ints if kind == "int" else for_floats
        at = self.at(node) if "{at}" in template else ""
        return Number(kind, template.format(self.code(left, kind), self.code(right, kind), at=at))

    # truth

    def truth(self, value: Value, node: ast.AST) -> Value:
        """Whether a value is true: a truth value, known or not."""
        if isinstance(value, Series):
            value = value.length
        if not isinstance(value, Number):
            return bool(value)
        if value.kind == "text":
            raise Outside(node, "a text as a condition")
        return value if value.kind == "bool" else Number("bool", f"({value.code} != 0)")

    def condition(self, node: ast.expr) -> Value:
        """Whether an expression is true; the later parts of ``and`` and ``or`` are worked out only where they count."""
        if not isinstance(node, ast.BoolOp):
            return self.truth(self.expression(node), node)
        return self._either(node, [partial(self.condition, each) for each in node.values])

    def _BoolOp(self, node: ast.BoolOp) -> Value:
        return self._either(node, [partial(self.expression, each) for each in node.values])

    def _either(self, node: ast.BoolOp, parts: list[Callable[[], Value]]) -> Value:
        """``and`` or ``or`` of parts, of which the later ones are worked out where the first one does not decide."""
        first = parts[0]() if len(parts) == 1 else self.hold(parts[0]())
        if len(parts) == 1:
            return first
        rest = partial(self._either, node, parts[1:])
        one, other = (rest, lambda: first) if isinstance(node.op, ast.And) else (lambda: first, rest)
        return self.choose(self.truth(first, node), one, other, node)

    def _IfExp(self, node: ast.IfExp) -> Value:
        one, other = partial(self.expression, node.body), partial(self.expression, node.orelse)
        return self.choose(self.condition(node.test), one, other, node)

    def choose(self, test: Value, one: Callable[[], Value], other: Callable[[], Value], node: ast.AST) -> Value:
        """One of two values, of which only the chosen one is worked out."""
        if not isinstance(test, Number):
            return one() if test else other()
        (first, before), (second, otherwise) = self.captured(one), self.captured(other)
        shape = self.join(first, second, node, "a value that is {} or {}")
        if isinstance(shape, Number) and not before and not otherwise:
            codes = self.code(first, shape.kind), self.code(second, shape.kind)
            return Number(shape.kind, f"({test.code} ? {codes[0]} : {codes[1]})")
        names = self.variables(shape)
        for opening, lines, value in ((f"if ((bool){test.code}) {{", before, first), ("} else {", otherwise, second)):
            self.emit(opening, *lines, *map("{} = {};".format, names, self.codes(value, shape)))
        self.emit("}")
        return rebuilt(shape, iter(names))

    def _Compare(self, node: ast.Compare) -> Value:
        values = [self.expression(each) for each in (node.left, *node.comparators)]
        if len(values) > 2:
            values = [self.hold(value) for value in values]
        return _all(map(self.compared, node.ops, values, values[1:], [node] * len(node.ops)))

    def compared(self, operation: ast.cmpop, one: Value, other: Value, node: ast.AST) -> Value:
        """A comparison of two values: a truth value, known or not."""
        if inverse := _INVERSE.get(type(operation)):
            return _negated(self.compared(inverse(), one, other, node))
        if isinstance(operation, ast.In):
            return self._contained(one, other, node)
        kinds = {kind_of(one), kind_of(other)}
        if isinstance(operation, ast.Is):
            if one in (None, ...) or other in (None, ...):
                return one is other
            if kinds != {"bool"}:
                raise Outside(node, "is with anything but None, True or False")
            operation = ast.Eq()
        is_equality = isinstance(operation, ast.Eq)
        if is_equality and isinstance(one, list | tuple) and isinstance(other, list | tuple):
            if type(one) is not type(other) or len(one) != len(other):
                return False
            return _all(self.compared(operation, *pair, node) for pair in zip(one, other, strict=True))
        if None in kinds:
            raise Outside(node, f"a comparison of {described(one)} with {described(other)}")
        if "text" in kinds and not is_equality:
            raise Outside(node, "an order of texts")
        if "text" in kinds and len(kinds) > 1:
            return False
        compute, sign = _ORDER[type(operation)]
        if is_known([one, other]):
            return compute(one, other)
        kind = joined(shape_of(one), shape_of(other)).kind
        return Number("bool", f"({self.code(one, kind)} {sign} {self.code(other, kind)})")

    def _contained(self, one: Value, other: Value, node: ast.AST) -> Value:
        if other is PARAMS and isinstance(one, str):
            return one in BY_NAME
        if isinstance(other, dict | list | tuple) and not is_table(other):
            held = self.hold(one)
            return _negated(_all(_negated(self.compared(ast.Eq(), held, item, node)) for item in other))
        return self.reduced("contains", node, other, {"py_value": one})

    def reduced(self, name: str, node: ast.AST, source: Any, options: dict[str, Value]) -> Value:
        """The result of a function of many items."""
        raise NotImplementedError

    # items

    def _Subscript(self, node: ast.Subscript) -> Value:
        base = self.expression(node.value)
        if not isinstance(node.slice, ast.Slice):
            return self.item(base, self.expression(node.slice), node)
        parts = (node.slice.lower, node.slice.upper, node.slice.step)
        bounds = [None if each is None else self.expression(each) for each in parts]
        if not all(each is None or isinstance(each, int) for each in bounds):
            raise Outside(node, "a slice whose bounds are not known")
        if not isinstance(base, list | tuple) or bounds[2] == 0:
            raise Outside(node, f"a slice of {described(base)}")
        return base[slice(*bounds)]

    def item(self, base: Value, index: Value, node: ast.AST) -> Value:
        """``base[index]``."""
        if base is PARAMS:
            return self._parameter(index, node)
        if isinstance(base, dict):
            return self._entry(base, index, node)
        if self.kind(index, node) == "float":
            raise Outside(node, "an index that is a float")
        if isinstance(base, list | tuple) and is_known(index) and -len(base) <= index < len(base):
            return base[index]
        if not isinstance(base, list | tuple) and not (isinstance(base, Series) and base.is_list):
            raise Outside(node, f"an item of {described(base)}")
        length = base.length if isinstance(base, Series) else len(base)
        code = f"py_index({self.code(index, 'int')}, {self.code(length, 'int')}, {self.at(node)})"
        place = Number("int", self.variable("int", code))
        return base.item(place) if isinstance(base, Series) else self._row(base, place, node)

    def _row(self, items: list[Value] | tuple[Value, ...], place: Value, node: ast.AST) -> Value:
        """One of several values, by an index that is valid: each number of a row has an array of C++."""
        if isinstance(place, int) or not items:
            return items[place] if items else 0
        shape = shape_of(items[0], whole=False)
        for item in items[1:]:
            shape = self.join(
                shape, shape_of(item, whole=False), node, "a list whose items have several types, such as {} and {}"
            )
        if not flat(shape):
            raise Outside(node, f"a list whose items are {described(items[0])}")
        names, known = [], is_known(items)
        for kind, column in zip(
            flat(shape), zip(*(self.codes(item, shape) for item in items), strict=True), strict=True
        ):
            name, text = f"t{self.program.number()}", f"const {C_TYPES[kind]} {{}}[] = {{{{{', '.join(column)}}}}};"
            if known:
                name = self.program.tables.setdefault(f"static {text}", name)
            else:
                self.emit(text.format(name))
            names.append(f"{name}[{place.code}]")
        return rebuilt(shape, iter(names))

    def _parameter(self, name: Value, node: ast.AST) -> Value:
        """``params[name]``."""
        if not isinstance(name, str):
            raise Outside(node, "a key of params that is not known")
        if name not in BY_NAME:
            raise Outside(node, f"params has no key {name!r} ({nearest(name, BY_NAME)})")
        found = BY_NAME[name]
        if found.shape == "one":
            return Number(found.kind, f"p_{name}")
        if found.shape == "two":
            return [Number("int", f"p_{name}_{place}") for place in (0, 1)]
        is_objects = found.shape == "objects"
        read, first = ("py_object", OBJECT_COLUMNS[name]) if is_objects else ("py_waypoint", 0)

        def item(index: Value) -> Value:
            cells = [f"{read}({self.code(index, 'int')}, {first + column})" for column in range(found.width)]
            if found.points:
                return tuple(Number("float", cell) for cell in cells)
            return Number(found.kind, cells[0] if found.kind == "float" else f"({cells[0]} != 0.0)")

        length = Number("int", "count_objects" if is_objects else "count_waypoints")
        return Series(f"params['{name}']", length, item, is_list=True)

    def _entry(self, entries: dict[Any, Value], key: Value, node: ast.AST) -> Value:
        """An entry of a constant dictionary."""
        if is_known(key):
            if not _is_key(key) or key not in entries:
                raise Outside(node, f"a dictionary without the key {key!r}")
            return entries[key]
        if len(entries) > 4 * LONGEST_GROUP:
            raise Outside(node, "a long dictionary whose key is not known")
        held, place = self.hold(key), self.variable("int", "-1", const="")
        for count, each in enumerate(entries):
            same = self.code(self.compared(ast.Eq(), held, each, node), "bool")
            self.emit(f"if ((bool){same}) {place} = {count};")
        self.emit(f"if ({place} < 0) py_fail({self.at(node, KEY)});")
        return self._row(list(entries.values()), Number("int", place), node)

    # loops

    def series(self, value: Value, node: ast.AST) -> Series:
        """The items of a loop."""
        if isinstance(value, Series):
            return value
        if not isinstance(value, dict | list | tuple):
            raise Outside(node, f"a loop over {described(value)}")
        held = self.hold(list(value) if isinstance(value, dict) else value)
        return Series("a list", len(held), lambda place: self._row(held, place, node))

    def each(self, value: Value, node: ast.AST, body: Callable[[Value], None]) -> None:
        """A loop: ``body`` adds the lines that use an item."""
        found = self.series(value, node)
        count, index = self.variable("int", self.code(found.length, "int")), f"i{self.program.number()}"
        self.check()
        self.emit(f"for (long long {index} = 0; {index} < {count}; ++{index}) {{", self.round(node))
        body(found.item(Number("int", index)))
        self.check()
        self.emit("}")

    def round(self, node: ast.AST) -> str:
        """A line that counts how often loops go round."""
        return f"if (--rounds < 0) {{ py_fail({16 * getattr(node, 'lineno', 0) + LOOP}); return; }}"


def _negated(value: Value) -> Value:
    return Number("bool", f"(!{value.code})") if isinstance(value, Number) else not value


def _all(values: Iterable[Value]) -> Value:
    """Whether all truth values are true."""
    found = [each for each in values if each is not True]
    if False in found or not found:
        return not found
    return found[0] if len(found) == 1 else Number("bool", f"({' && '.join(each.code for each in found)})")


def _is_key(value: Value) -> bool:
    return all(isinstance(each, str | int | float) for each in (value if isinstance(value, tuple) else [value]))


def fits(value: Value) -> bool:
    """Whether all ints of a known value have less than 64 bit."""
    return all(map(fits, value)) if isinstance(value, list | tuple) else type(value) is not int or abs(value) < 2**62


def _computed(compute: Any, one: Any, other: Any) -> Value:
    """The result of an operation of known numbers; None where it has none, or is too large to be worked out here."""
    if max(abs(one), abs(other)) > 1e15 or (compute is operator.pow and abs(other) > _MOST_POWER):
        return None
    try:
        result = compute(one, other)
    except ArithmeticError:
        return None
    return result if type(result) in KINDS and fits(result) else None


_REFUSED = {
    "JoinedStr": "a text that is made when it runs",
    "DictComp": "a dictionary that is made when it runs",
    "SetComp": "a set",
    "Set": "a set",
    "Await": "await",
    "Yield": "yield",
    "NamedExpr": "an assignment inside an expression (:=)",
    "Starred": "a starred item",
    "GeneratorExp": "a generator in this place",
}
