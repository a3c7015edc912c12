"""Calls in a reward function: built-in functions, those of modules, its own, and what is worked out over many items."""

from __future__ import annotations

import ast
import inspect
from collections.abc import Callable, Sequence
from typing import Any

from racer.rewards.parameters import BY_NAME
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
from racer.rewards.translation.expressions import Expressions
from racer.rewards.translation.items import Iterated
from racer.rewards.translation.mathematics import FUNCTIONS, QUIET
from racer.rewards.translation.prelude import EMPTY
from shared_store.contract.error_text import counted

_FOLDS = {"sum": "start", "min": "default", "max": "default", "any": None, "all": None, "len": None}
"""The option that each of them has beside ``key``."""
_Comprehension = ast.GeneratorExp | ast.ListComp


class Calls(Expressions):
    """Translates calls."""

    def _Call(self, node: ast.Call) -> Value:
        if any(isinstance(each, ast.Starred) for each in node.args) or any(each.arg is None for each in node.keywords):
            raise Outside(node, "a call with * or **")
        if isinstance(node.func, ast.Attribute):
            return self._method(node, node.func)
        return self.called(self.expression(node.func), node)

    def _method(self, node: ast.Call, function: ast.Attribute) -> Value:
        base = self.expression(function.value)
        if isinstance(base, Thing) and base.kind == "module":
            return self.called(self.expression(function), node)
        if function.attr == "get" and not node.keywords and 1 <= len(node.args) <= 2:
            return self._get(base, node)
        if function.attr in ("append", "extend", "insert"):
            raise Outside(node, "a list that grows")
        if function.attr in ("format", "join"):
            raise Outside(node, "a text that is made when it runs")
        if isinstance(base, Constant) and isinstance(base.value, dict) and not node.args + node.keywords:
            entries = base.value
            parts = {"keys": list(entries), "values": list(entries.values()), "items": list(entries.items())}
            if function.attr in parts:
                return self.program.wrap(parts[function.attr], node)
        raise Outside(node, f"the method {function.attr} of {described(shape_of(base))}")

    def _get(self, base: Value, node: ast.Call) -> Value:
        key = self.expression(node.args[0])
        known = key.constant if isinstance(key, Number) else None
        if known is None:
            raise Outside(node, "get() of a key that is not known")
        if isinstance(base, Thing) and base.kind == "params":
            there = known in BY_NAME
        elif isinstance(base, Constant) and isinstance(base.value, dict):
            there = known in base.value
        else:
            raise Outside(node, f"get() of {described(shape_of(base))}")
        if there:
            return self.item(base, key, node)
        return self.expression(node.args[1]) if len(node.args) == 2 else self.program.wrap(None, node)

    def called(self, function: Value, node: ast.Call) -> Value:
        """The result of a call."""
        if not isinstance(function, Thing) or function.kind not in ("builtin", "function"):
            raise Outside(node, f"a call of {described(shape_of(function))}")
        if function.kind == "function":
            arguments = [self.expression(each) for each in node.args]
            named = {each.arg: self.expression(each.value) for each in node.keywords if each.arg}
            return self.apply(function, arguments, named, node)
        if function.name == "print":
            self.program.note(node.lineno, "print() is left out")
            return self.program.wrap(None, node)
        if function.name in _FOLDS and len(node.args) >= 1 and isinstance(node.args[0], _Comprehension):
            return self._folded(function.name, node, node.args[0])
        if function.name in ("min", "max") and any(each.arg in ("key", "default") for each in node.keywords):
            return self._best(function.name, node)
        if node.keywords:
            raise Outside(node, f"{function.name}() with {node.keywords[0].arg}=")
        method: Callable[..., Value] | None = getattr(self, f"_{function.name}", None)
        arguments = [self.expression(each) for each in node.args]
        if method is not None and "." not in function.name:
            try:
                inspect.signature(method).bind(node, *arguments)
            except TypeError:
                raise Outside(node, f"{function.name}() with {counted(len(arguments), 'argument')}") from None
            return method(node, *arguments)
        return self._mathematical(function.name, arguments, node)

    def apply(self, function: Thing, arguments: Sequence[Value], named: dict[str, Value], node: ast.AST) -> Value:
        """The result of a function of the file. Each file's translation defines it."""
        raise NotImplementedError

    def _mathematical(self, name: str, arguments: Sequence[Value], node: ast.Call) -> Value:
        module, _, function = name.rpartition(".")
        table = {"math": FUNCTIONS, "numpy": QUIET}.get(module, {})
        if name in ("math.dist", "math.hypot", "numpy.hypot", "numpy.linalg.norm"):
            return self._distance(name, arguments, node)
        if function not in table:
            raise Outside(node, f"{name}()")
        found = table[function]
        if len(arguments) not in found.counts:
            raise Outside(node, f"{name}() with {counted(len(arguments), 'argument')}")
        numbers = [self.numeric(each, node) for each in arguments]
        held = [self.hold(each) for each in numbers]
        at = self.at(node) if found.may_fail else ""
        return found.make([cast(self.numeric(each, node), "float") for each in held], at)

    def _distance(self, name: str, arguments: Sequence[Value], node: ast.Call) -> Value:
        parts: Sequence[Value] = arguments
        if name == "math.dist" and len(arguments) == 2:
            one, other = arguments
            if not (isinstance(one, ItemList) and isinstance(other, ItemList) and len(one.items) == len(other.items)):
                raise Outside(node, "math.dist() of anything but two points")
            parts = [self.binary(ast.Sub(), *pair, node) for pair in zip(one.items, other.items, strict=True)]
        elif name == "numpy.linalg.norm" and len(arguments) == 1 and isinstance(arguments[0], ItemList):
            parts = arguments[0].items
        elif name != "math.hypot" and (name != "numpy.hypot" or len(arguments) != 2):
            raise Outside(node, f"{name}() in this form")
        held = [cast(self.numeric(self.hold(self.numeric(part, node)), node), "float") for part in parts]
        return Number("float", f"::sqrt({' + '.join(f'{part} * {part}' for part in held) or '0.0'})")

    # built-in functions, by their names

    def _abs(self, node: ast.Call, value: Value) -> Value:
        found = self.numeric(value, node)
        if found.kind == "float":
            return Number("float", f"::fabs({found.code})")
        held = self.numeric(self.hold(Number("int", cast(found, "int"))), node)
        return Number("int", f"({held.code} < 0 ? -{held.code} : {held.code})")

    def _float(self, node: ast.Call, value: Value | None = None) -> Value:
        if isinstance(value, Number) and value.kind == "text" and value.constant in ("inf", "-inf", "nan"):
            return number(float(value.constant))
        found = number(0.0) if value is None else self.numeric(value, node)
        return number(float(found.constant)) if found.constant is not None else Number("float", cast(found, "float"))

    def _int(self, node: ast.Call, value: Value | None = None) -> Value:
        found = number(0) if value is None else self.numeric(value, node)
        if found.kind == "float":
            return Number("int", f"py_int({found.code}, {self.at(node)})")
        return Number("int", cast(found, "int"), None if found.constant is None else int(found.constant))

    def _bool(self, node: ast.Call, value: Value | None = None) -> Value:
        return number(False) if value is None else self.truth(value, node)

    def _round(self, node: ast.Call, value: Value, digits: Value | None = None) -> Value:
        found = self.numeric(value, node)
        places = digits.constant if isinstance(digits, Number) else None
        if found.kind != "float":
            if digits is not None:
                raise Outside(node, "round() of an int with digits")
            return Number("int", cast(found, "int"))
        if digits is None or (isinstance(digits, Constant) and digits.value is None):
            return Number("int", f"py_int(::rint({found.code}), {self.at(node)})")
        if not isinstance(places, int) or not 0 <= places <= 6:
            raise Outside(node, "round() to anything but 0 to 6 digits")
        return Number("float", f"py_round({found.code}, {places}, {self.at(node)})")

    def _pow(self, node: ast.Call, base: Value, exponent: Value) -> Value:
        return self.binary(ast.Pow(), base, exponent, node)

    def _divmod(self, node: ast.Call, one: Value, other: Value) -> Value:
        one, other = self.hold(one), self.hold(other)
        return ItemList((self.binary(ast.FloorDiv(), one, other, node), self.binary(ast.Mod(), one, other, node)))

    def _len(self, node: ast.Call, value: Value) -> Value:
        if isinstance(value, Constant) and isinstance(value.value, list | tuple | dict):
            return number(len(value.value))
        found = self.iterated(value, node)
        return number(found.known) if found.known is not None else Number("int", found.length)

    def _list(self, node: ast.Call, value: Value | None = None) -> Value:
        if value is None:
            raise Outside(node, "a list that grows")
        if isinstance(value, RuntimeList | ItemList) or (
            isinstance(value, Constant) and isinstance(value.value, list | tuple)
        ):
            return value
        raise Outside(node, f"a list of {described(shape_of(value))}")

    _tuple = _list

    def _str(self, node: ast.Call, *_: Value) -> Value:
        raise Outside(node, "a text that is made when it runs")

    def _range(self, node: ast.Call, *bounds: Value) -> Value:
        if not 1 <= len(bounds) <= 3:
            raise Outside(node, f"range() with {counted(len(bounds), 'argument')}")
        numbers = [self.numeric(each, node) for each in bounds]
        if any(each.kind == "float" for each in numbers):
            raise Outside(node, "range() of a float")
        full = [number(0), *numbers, number(1)] if len(numbers) == 1 else [*numbers, number(1)][:3]
        first, last, step = (self.numeric(self.hold(each), node) for each in full)
        known = None
        if first.constant is not None and last.constant is not None and step.constant:
            known = len(range(first.constant, last.constant, step.constant))
        length = (
            str(known) if known is not None else f"py_steps({first.code}, {last.code}, {step.code}, {self.at(node)})"
        )
        scope = Iterated(length, lambda index: Number("int", f"({first.code} + {index} * {step.code})"), known)
        return Thing("iterated", "a range", node, scope)

    def _enumerate(self, node: ast.Call, value: Value, start: Value | None = None) -> Value:
        found, first = self.iterated(value, node), number(0) if start is None else self.numeric(start, node)

        def item(index: str) -> Value:
            return ItemList((Number("int", f"({first.code} + {index})"), found.item(index)))

        return Thing("iterated", "an enumeration", node, Iterated(found.length, item, found.known))

    def _zip(self, node: ast.Call, *values: Value) -> Value:
        found = [self.iterated(each, node) for each in values]
        if not found:
            raise Outside(node, "zip() of nothing")
        known = [each.known for each in found]
        least = min(each for each in known if each is not None) if None not in known else None
        length = found[0].length
        for each in found[1:]:
            name = self.fresh()
            self.emit(f"const long long {name} = {each.length} < {length} ? {each.length} : {length};")
            length = name
        scope = Iterated(length, lambda index: ItemList(tuple(each.item(index) for each in found)), least)
        return Thing("iterated", "a zip", node, scope)

    def _reversed(self, node: ast.Call, value: Value) -> Value:
        found = self.iterated(value, node)
        name = self.fresh()
        self.emit(f"const long long {name} = {found.length};")
        scope = Iterated(name, lambda index: found.item(f"({name} - 1 - {index})"), found.known)
        return Thing("iterated", "a reversed list", node, scope)

    def _min(self, node: ast.Call, *values: Value) -> Value:
        return self._extreme("min", node, *values)

    def _max(self, node: ast.Call, *values: Value) -> Value:
        return self._extreme("max", node, *values)

    def _extreme(self, name: str, node: ast.Call, *values: Value) -> Value:
        items: tuple[Value, ...] = values
        if len(values) == 1:
            if not isinstance(values[0], ItemList):
                return self._fold(name, node, lambda use: self.each(values[0], node, use))
            items = values[0].items
        if not items:
            raise Outside(node, f"{name}() of nothing")
        sign, best = "<" if name == "min" else ">", self.numeric(items[0], node)
        for item in items[1:]:
            other = self.numeric(item, node)
            kind = joined(best.kind, other.kind)
            one, two = (self.numeric(self.hold(Number(kind, cast(each, kind))), node) for each in (best, other))
            best = Number(kind, f"({two.code} {sign} {one.code} ? {two.code} : {one.code})")
        return best

    def _sum(self, node: ast.Call, value: Value, start: Value | None = None) -> Value:
        return self._fold("sum", node, lambda use: self.each(value, node, use), start)

    def _any(self, node: ast.Call, value: Value) -> Value:
        return self._fold("any", node, lambda use: self.each(value, node, use))

    def _all(self, node: ast.Call, value: Value) -> Value:
        return self._fold("all", node, lambda use: self.each(value, node, use))

    # what is worked out over many items

    def _folded(self, name: str, node: ast.Call, items: _Comprehension) -> Value:
        options = {each.arg: each.value for each in node.keywords}
        if name in ("min", "max") and "key" in options:
            return self._best(name, node)
        starts = [*node.args[1:], *options.values()]
        is_refused = (name == "len" and isinstance(items, ast.GeneratorExp)) or (name != "sum" and len(node.args) > 1)
        if is_refused or len(starts) > 1 or set(options) - {_FOLDS[name]}:
            raise Outside(node, f"{name}() in this form")
        start = self.expression(starts[0]) if starts else None
        return self._fold(name, node, lambda use: self.over(items, use), start)

    def over(self, node: _Comprehension, use: Callable[[Value], None], place: int = 0) -> None:
        """Go through the items of a comprehension; ``use`` adds the lines for one."""
        if place == len(node.generators):
            use(self.expression(node.elt))
            return
        generator = node.generators[place]

        def one(item: Value) -> None:
            held = self.hold(item)
            self.overlay.append({})
            self.unpack(generator.target, held, self._keep)
            for test in generator.ifs:
                self.emit(f"if (!{self.condition(test).code}) continue;")
            self.over(node, use, place + 1)
            self.overlay.pop()

        self.each(self.expression(generator.iter), node, one)

    def _keep(self, name: str, value: Value, node: ast.AST) -> None:
        """Give a variable of the innermost comprehension its value."""
        self.overlay[-1][name] = value

    def unpack(self, target: ast.expr, value: Value, store: Callable[[str, Value, ast.AST], None]) -> None:
        """Give the names of a target their values."""
        if isinstance(target, ast.Name):
            store(target.id, value, target)
        elif isinstance(target, ast.Tuple | ast.List):
            if isinstance(value, Constant) and isinstance(value.value, list | tuple):
                value = ItemList(tuple(self.program.wrap(each, target) for each in value.value))
            if not isinstance(value, ItemList) or len(value.items) != len(target.elts):
                raise Outside(target, f"{len(target.elts)} names for {described(shape_of(value))}")
            for each, item in zip(target.elts, value.items, strict=True):
                self.unpack(each, item, store)
        else:
            raise Outside(target, "a list whose items are changed" if isinstance(target, ast.Subscript) else "a target")

    def _fold(
        self, name: str, node: ast.AST, loop: Callable[[Callable[[Value], None]], None], start: Value | None = None
    ) -> Value:
        """``sum``, ``min``, ``max``, ``any``, ``all`` or ``len`` of what a loop goes through."""
        result, seen = self.fresh(), self.fresh()
        kinds: list[str] = []

        def look(item: Value) -> None:
            if name in ("sum", "min", "max"):
                kinds.append(self.numeric(item, node).kind)

        self.captured(lambda: loop(look))  # tells the type
        kind = {"any": "bool", "all": "bool", "len": "int"}.get(name) or (kinds[0] if kinds else "int")
        first = number({"all": True, "any": False}.get(name, 0)) if start is None else self.numeric(start, node)
        if name == "sum":
            kind = joined("int" if kind == "bool" else kind, first.kind if first.kind != "bool" else "int")
        elif start is not None:
            kind = joined(kind, first.kind)
        self.emit(f"{C_TYPES[kind]} {result} = {cast(first, kind)}; bool {seen} = false;")

        def use(item: Value) -> None:
            if name in ("any", "all"):
                sign = "" if name == "any" else "!"
                decided = "true" if name == "any" else "false"
                self.emit(f"if {parenthesised(sign + self.truth(item, node).code)} {{ {result} = {decided}; break; }}")
            elif name == "len":
                self.emit(f"{result} += 1;")
            elif name == "sum":
                added = self.binary(ast.Add(), Number(kind, result), item, node)
                self.emit(f"{result} = {cast(self.numeric(added, node), kind)};")
            else:
                held = cast(self.numeric(self.hold(self.numeric(item, node)), node), kind)
                self.emit(f"if (!{seen} || {held} {'<' if name == 'min' else '>'} {result}) {result} = {held};")
                self.emit(f"{seen} = true;")

        loop(use)
        if name in ("min", "max") and start is None:
            self.emit(f"if (!{seen}) py_fail({self.at(node)} + {EMPTY});")
        return Number(kind, result)

    def _best(self, name: str, node: ast.Call) -> Value:
        """``min`` or ``max`` with ``key=``: the first item of the least or greatest key."""
        options = {each.arg: each.value for each in node.keywords}
        if len(node.args) != 1 or set(options) - {"key", "default"}:
            raise Outside(node, f"{name}() in this form")
        source = node.args[0]
        if isinstance(source, _Comprehension):
            values: Value | None = None
        else:
            values = self.expression(source)

        def loop(use: Callable[[Value], None]) -> None:
            if values is None:
                assert isinstance(source, _Comprehension)
                self.over(source, use)
            else:
                self.each(values, node, use)

        if "key" not in options:
            return self._fold(name, node, loop, self.expression(options["default"]))
        if "default" in options:
            raise Outside(node, f"{name}() with key= and default=")
        key = (
            self.expression(options["key"])
            if not isinstance(options["key"], ast.Lambda)
            else self._Lambda(options["key"])
        )
        shapes: list[Any] = []

        def keyed(item: Value) -> Number:
            if isinstance(key, Thing) and key.kind == "function":
                return self.numeric(self.apply(key, [item], {}, node), node)
            raise Outside(node, f"{name}() with a key that is no function of the file")

        def look(item: Value) -> None:
            shapes.append((shape_of(item), keyed(self.hold(item)).kind))

        self.captured(lambda: loop(look))
        shape, kind = shapes[0]
        names, best, seen = [self.fresh() for _ in flat(shape)], self.fresh(), self.fresh()
        for each, letter in zip(names, flat(shape), strict=True):
            self.emit(f"{C_TYPES[letter]} {each} = 0;")
        self.emit(f"{C_TYPES[kind]} {best} = 0; bool {seen} = false;")

        def use(item: Value) -> None:
            held = self.hold(item)
            found = cast(self.numeric(self.hold(keyed(held)), node), kind)
            kept = " ".join(f"{each} = {code};" for each, code in zip(names, codes(held, shape), strict=True))
            sign = "<" if name == "min" else ">"
            self.emit(f"if (!{seen} || {found} {sign} {best}) {{ {best} = {found}; {seen} = true; {kept} }}")

        loop(use)
        self.emit(f"if (!{seen}) py_fail({self.at(node)} + {EMPTY});")
        return rebuilt(shape, list(names))

    def _Lambda(self, node: ast.Lambda) -> Value:
        return Thing("function", "lambda", node, self)

    def _ListComp(self, node: ast.ListComp) -> Value:
        """A list of known length, item by item."""
        generator = node.generators[0]
        if len(node.generators) > 1 or generator.ifs:
            raise Outside(node, "a list that grows")
        found = self.iterated(self.expression(generator.iter), node)
        if found.known is None or found.known > LONGEST_GROUP:
            raise Outside(node, "a list that grows")
        items = []
        for index in range(found.known):
            self.overlay.append({})
            self.unpack(generator.target, self.hold(found.item(str(index))), self._keep)
            items.append(self.hold(self.expression(node.elt)))
            self.overlay.pop()
        return ItemList(tuple(items))
