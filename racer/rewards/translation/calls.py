"""Calls in a reward function: built-in functions, those of modules, and what is worked out over many items."""

from __future__ import annotations

import ast
import builtins
import copy
import inspect
import math
from collections.abc import Sequence
from typing import Any

from racer.rewards.parameters import BY_NAME
from racer.rewards.translation.expression_values import (
    KINDS,
    LONGEST_GROUP,
    PARAMS,
    Function,
    Known,
    Number,
    Outside,
    Series,
    Value,
    described,
    is_known,
    joined,
    kept,
)
from racer.rewards.translation.expressions import Expressions, fits
from racer.rewards.translation.prelude import EMPTY, FUNCTIONS
from shared_store.contract.error_text import counted

BUILTINS = {
    *("abs", "all", "any", "bool", "divmod", "enumerate", "float", "int", "len", "list", "max", "min", "pow", "print"),
    *("range", "reversed", "round", "str", "sum", "tuple", "zip", "py_empty"),
}
_LEAST = """
def min(py_items, py_key=None, py_default=...):
    py_found = False
    for py_item in py_items:
        py_rank = py_item if py_key is None else py_key(py_item)
        if not py_found or py_rank < py_least:
            py_best, py_least, py_found = py_item, py_rank, True
    if not py_found:
        if py_default is ...:
            py_empty()
        else:
            return py_default
    return py_best
"""
_LOOPS: dict[str, ast.FunctionDef] = {
    each.name: each
    for each in ast.parse(
        f"""
def sum(py_items, py_start=0):
    for py_item in py_items:
        py_start = py_start + py_item
    return py_start
def any(py_items):
    for py_item in py_items:
        if py_item:
            return True
    return False
def all(py_items):
    for py_item in py_items:
        if not py_item:
            return False
    return True
def contains(py_items, py_value):
    for py_item in py_items:
        if py_item == py_value:
            return True
    return False
{_LEAST}{_LEAST.replace("min", "max").replace("<", ">")}"""
    ).body
    if isinstance(each, ast.FunctionDef)
}
"""Functions of many items in Python, which are translated where they are called."""
_OF_KNOWN = {"abs", "all", "any", "bool", "divmod", "len", "list", "max", "min", "round", "sum", "tuple"}
"""Built-in functions whose result is Python's own where all that they are given is known."""
_Comprehension = ast.GeneratorExp | ast.ListComp


class Calls(Expressions):
    """Translates calls."""

    def _Call(self, node: ast.Call) -> Value:
        if isinstance(node.func, ast.Attribute):
            base = self.expression(node.func.value)
            if not isinstance(base, Known) or base.kind != "module":
                return self._method(base, node.func.attr, node)
        function = self.expression(node.func)
        if isinstance(function, Function):
            named = {str(each.arg): self.expression(each.value) for each in node.keywords}
            arguments = [self.expression(each) for each in node.args]
            kept([*arguments, *named.values()], node)
            return self.apply(function, arguments, named, node)
        if not isinstance(function, Known) or function.kind != "builtin":
            raise Outside(node, f"a call of {described(function)}")
        return self._built_in(function.name, node)

    def apply(self, function: Function, arguments: Sequence[Value], named: dict[str, Value], node: ast.AST) -> Value:
        """The result of a function of the file."""
        raise NotImplementedError

    def _method(self, base: Value, name: str, node: ast.Call) -> Value:
        if name in ("append", "extend", "insert"):
            raise Outside(node, "a list that grows")
        if name in ("format", "join"):
            raise Outside(node, "a text that is made when it runs")
        if isinstance(base, dict) and name in ("keys", "values", "items") and not node.args + node.keywords:
            return list(getattr(base, name)())
        if name != "get" or node.keywords or not 1 <= len(node.args) <= 2:
            raise Outside(node, f"the method {name} of {described(base)}")
        if base is not PARAMS and not isinstance(base, dict):
            raise Outside(node, f"get() of {described(base)}")
        key = self.expression(node.args[0])
        if type(key) not in KINDS:
            raise Outside(node, "get() of a key that is not known")
        if key in (base if isinstance(base, dict) else BY_NAME):
            return self.item(base, key, node)
        return self.expression(node.args[1]) if len(node.args) == 2 else None

    def _built_in(self, name: str, node: ast.Call) -> Value:
        if name == "print":
            self.program.notes[f"line {node.lineno}: print() is left out"] = None
            return None
        if name == "py_empty":
            self.emit(f"py_fail({self.at(node, EMPTY)});")
            return None
        if name in _LOOPS:
            return self._over_items(name, node)
        if name == "len" and node.args and isinstance(node.args[0], ast.ListComp):
            counting = ast.copy_location(ast.GeneratorExp(ast.Constant(1), node.args[0].generators), node)
            return self.reduced("sum", node, counting, {})
        if node.keywords:
            raise Outside(node, f"{name}() with {node.keywords[0].arg}=")
        arguments = [self.expression(each) for each in node.args]
        if (value := _of_known(name, arguments)) is not ...:
            return value
        method = getattr(self, f"_{name}", None) if name in BUILTINS else None
        if method is None:
            return self._mathematical(name, arguments, node)
        try:
            inspect.signature(method).bind(node, *arguments)
        except TypeError:
            raise Outside(node, f"{name}() with {counted(len(arguments), 'argument')}") from None
        return method(node, *arguments)

    def _over_items(self, name: str, node: ast.Call) -> Value:
        """``sum``, ``any``, ``all``, ``min`` or ``max``."""
        options = {f"py_{each.arg}": self.expression(each.value) for each in node.keywords}
        arguments = [each if isinstance(each, _Comprehension) else self.expression(each) for each in node.args]
        if not options and (value := _of_known(name, arguments)) is not ...:
            return value
        if name == "sum" and len(arguments) == 2:
            options["py_start"] = arguments.pop()
        is_extreme = name in ("min", "max") and not options
        items = arguments if len(arguments) > 1 else arguments[0] if arguments else None
        if is_extreme and isinstance(items, list | tuple) and not any(isinstance(each, ast.AST) for each in items):
            return self._extreme(name, node, items)
        if len(arguments) != 1 or set(options) - {each.arg for each in _LOOPS[name].args.args}:
            raise Outside(node, f"{name}() in this form")
        return self.reduced(name, node, items, options)

    def reduced(self, name: str, node: ast.AST, source: Any, options: dict[str, Value]) -> Value:
        """The result of one of :data:`_LOOPS`, whose loop becomes those of a generator where ``source`` is one."""
        function = copy.deepcopy(_LOOPS[name])
        for each in ast.walk(function):
            ast.copy_location(each, node)
        if isinstance(source, _Comprehension):
            place = next(place for place, each in enumerate(function.body) if isinstance(each, ast.For))
            loop = function.body[place]
            assert isinstance(loop, ast.For)
            body: list[ast.stmt] = [ast.Assign([loop.target], source.elt), *loop.body]
            for generator in reversed(source.generators):
                for test in reversed(generator.ifs):
                    body = [ast.If(test, body, [])]
                body = [outer := ast.For(generator.target, generator.iter, body, [])]
            outer.iter, source = loop.iter, self.expression(outer.iter)  # worked out outside, as in Python
            function.body[place] = ast.fix_missing_locations(ast.copy_location(outer, node))
        return self.apply(self.function(name, function, self), [source], options, node)

    def _ListComp(self, node: ast.ListComp) -> Value:
        """A list of known length, item by item."""
        generator = node.generators[0]
        found = self.series(self.expression(generator.iter), node)
        is_short = isinstance(found.length, int) and found.length <= LONGEST_GROUP
        if len(node.generators) > 1 or generator.ifs or not is_short:
            raise Outside(node, "a list that grows")
        item = ast.Name("py_item", ast.Load())
        body: list[ast.stmt] = [ast.Assign([generator.target], item), ast.Return(node.elt)]
        text = ast.FunctionDef("list", ast.parse("lambda py_item: 0", mode="eval").body.args, body, [])  # type: ignore[attr-defined]
        function = self.function("list", ast.fix_missing_locations(ast.copy_location(text, node)), self)
        return [self.apply(function, [found.item(index)], {}, node) for index in range(found.length)]

    def unpack(self, target: ast.expr, value: Value, store: Any) -> None:
        """Give the names of a target their values."""
        if isinstance(target, ast.Name):
            store(target.id, value, target)
        elif isinstance(target, ast.Tuple | ast.List):
            if not isinstance(value, list | tuple) or len(value) != len(target.elts):
                raise Outside(target, f"{len(target.elts)} names for {described(value)}")
            for each, item in zip(target.elts, value, strict=True):
                self.unpack(each, item, store)
        else:
            raise Outside(target, "a list whose items are changed" if isinstance(target, ast.Subscript) else "a target")

    def function(self, name: str, node: ast.FunctionDef | ast.Lambda, scope: Any) -> Function:
        """A function that is defined here, with the defaults of its parameters."""
        found, kinds = node.args, inspect.Parameter
        places = [*found.posonlyargs, *found.args]
        defaults = dict(zip(reversed(places), map(self.expression, reversed(found.defaults)), strict=False))
        defaults |= {
            each: self.expression(default)
            for each, default in zip(found.kwonlyargs, found.kw_defaults, strict=True)
            if default
        }
        if not is_known([*defaults.values()]):
            raise Outside(node, "a default that is not constant")
        if found.vararg or found.kwarg or getattr(node, "decorator_list", None):
            raise Outside(node, "a decorated function, or one with * or **")
        kind: dict[ast.arg, Any] = dict.fromkeys(places, kinds.POSITIONAL_OR_KEYWORD)
        kind |= dict.fromkeys(found.posonlyargs, kinds.POSITIONAL_ONLY) | dict.fromkeys(
            found.kwonlyargs, kinds.KEYWORD_ONLY
        )
        parameters = [kinds(each.arg, of, default=defaults.get(each, kinds.empty)) for each, of in kind.items()]
        return Function(name, node, scope, inspect.Signature(parameters))

    def _Lambda(self, node: ast.Lambda) -> Value:
        return self.function("lambda", node, self)

    # functions of numbers

    def _mathematical(self, name: str, arguments: Sequence[Value], node: ast.Call) -> Value:
        if name in ("math.dist", "math.hypot", "numpy.hypot", "numpy.linalg.norm"):
            return self._distance(name, arguments, node)
        if name == "math.log" and len(arguments) == 2:
            parts = [self._mathematical(name, [each], node) for each in arguments]
            return self.binary(ast.Div(), parts[0], parts[1], node)
        module, _, function = name.rpartition(".")
        code = FUNCTIONS.get(module, {}).get(function)
        if code is None:
            raise Outside(node, f"{name}()")
        if len(arguments) != 1 + ("{1}" in code) + ("{2}" in code):
            raise Outside(node, f"{name}() with {counted(len(arguments), 'argument')}")
        values = [self.code(self._float(node, self.hold(each)), "float") for each in arguments]
        kind = "int" if code.startswith("py_int(") else "bool" if function.startswith("is") else "float"
        return Number(kind, code.format(*values, at=self.at(node) if "{at}" in code else ""))

    def _distance(self, name: str, arguments: Sequence[Value], node: ast.Call) -> Value:
        parts = arguments
        groups = [each for each in arguments if isinstance(each, list | tuple)]
        if name == "math.dist" and len(groups) == len(arguments) == 2:
            if len(groups[0]) != len(groups[1]):
                raise Outside(node, "math.dist() of anything but two points")
            parts = [self.binary(ast.Sub(), one, other, node) for one, other in zip(*groups, strict=True)]
        elif name == "numpy.linalg.norm" and len(groups) == len(arguments) == 1:
            parts = groups[0]
        elif name != "math.hypot" and (name != "numpy.hypot" or len(arguments) != 2):
            raise Outside(node, f"{name}() in this form")
        held = [self.code(self._float(node, self.hold(part)), "float") for part in parts]
        return Number("float", f"::sqrt({' + '.join(f'{part} * {part}' for part in held) or '0.0'})")

    # built-in functions, by their names

    def _abs(self, node: ast.Call, value: Value) -> Value:
        if self.kind(value, node) == "float":
            return Number("float", f"::fabs({value.code})")
        held = self.code(self.hold(self._int(node, value)), "int")
        return Number("int", f"({held} < 0 ? -{held} : {held})")

    def _float(self, node: ast.Call, value: Value = 0.0) -> Value:
        if value in ("inf", "-inf", "nan") or (self.kind(value, node) and is_known(value)):
            return float(value)
        return Number("float", self.code(value, "float"))

    def _int(self, node: ast.Call, value: Value = 0) -> Value:
        if self.kind(value, node) != "float":
            return int(value) if is_known(value) else Number("int", self.code(value, "int"))
        return Number("int", f"py_int({self.code(value, 'float')}, {self.at(node)})")

    def _bool(self, node: ast.Call, value: Value = False) -> Value:
        return self.truth(value, node)

    def _round(self, node: ast.Call, value: Value, digits: Value = None) -> Value:
        if self.kind(value, node) != "float":
            if digits is not None:
                raise Outside(node, "round() of an int with digits")
            return self._int(node, value)
        code = self.code(value, "float")
        if digits is None:
            return Number("int", f"py_int(::rint({code}), {self.at(node)})")
        if not isinstance(digits, int) or not 0 <= digits <= 6:
            raise Outside(node, "round() to anything but 0 to 6 digits")
        return Number("float", f"py_round({code}, {int(digits)})")

    def _pow(self, node: ast.Call, base: Value, exponent: Value) -> Value:
        return self.binary(ast.Pow(), base, exponent, node)

    def _divmod(self, node: ast.Call, one: Value, other: Value) -> Value:
        one, other = self.hold(one), self.hold(other)
        return self.binary(ast.FloorDiv(), one, other, node), self.binary(ast.Mod(), one, other, node)

    def _len(self, node: ast.Call, value: Value) -> Value:
        return len(value) if isinstance(value, dict | list | tuple) else self.series(value, node).length

    def _list(self, node: ast.Call, value: Value = ()) -> Value:
        if not node.args:
            raise Outside(node, "a list that grows")
        if isinstance(value, Series) and value.is_list:
            return value
        if isinstance(value, list | tuple):
            return list(value) if getattr(node.func, "id", "") == "list" else tuple(value)
        raise Outside(node, f"a list of {described(value)}")

    _tuple = _list

    def _str(self, node: ast.Call, *_: Value) -> Value:
        raise Outside(node, "a text that is made when it runs")

    def _range(self, node: ast.Call, *bounds: Value) -> Value:
        if not 1 <= len(bounds) <= 3:
            raise Outside(node, f"range() with {counted(len(bounds), 'argument')}")
        if any(self.kind(each, node) == "float" for each in bounds):
            raise Outside(node, "range() of a float")
        full = (0, bounds[0], 1) if len(bounds) == 1 else (*bounds, 1)[:3]
        codes = [self.code(self.hold(each), "int") for each in full]
        if is_known(full) and full[2]:
            length: Value = len(range(*full))
        else:
            length = Number("int", f"py_steps({', '.join(codes)}, {self.at(node)})")
        return Series(
            "a range", length, lambda index: Number("int", f"({codes[0]} + {self.code(index, 'int')} * {codes[2]})")
        )

    def _enumerate(self, node: ast.Call, value: Value, start: Value = 0) -> Value:
        found, first = self.series(value, node), self.code(start, self.kind(start, node))

        def item(index: Value) -> Value:
            return Number("int", f"({first} + {self.code(index, 'int')})"), found.item(index)

        return Series("an enumeration", found.length, item)

    def _zip(self, node: ast.Call, *values: Value) -> Value:
        found = [self.series(each, node) for each in values]
        if not found:
            raise Outside(node, "zip() of nothing")
        length = self._extreme("min", node, [each.length for each in found])
        return Series("a zip", length, lambda index: tuple(each.item(index) for each in found))

    def _reversed(self, node: ast.Call, value: Value) -> Value:
        found = self.series(value, node)
        last = self.code(self.hold(found.length), "int")
        return Series(
            "a reversed list",
            found.length,
            lambda index: found.item(Number("int", f"({last} - 1 - {self.code(index, 'int')})")),
        )

    def _extreme(self, name: str, node: ast.AST, items: Sequence[Value]) -> Value:
        """The least or greatest of a few numbers."""
        if not items:
            raise Outside(node, f"{name}() of nothing")
        best = items[0]
        for item in items[1:]:
            kind = joined(Number(self.kind(best, node)), Number(self.kind(item, node))).kind
            one, other = (self.code(self.hold(Number(kind, self.code(each, kind))), kind) for each in (best, item))
            best = Number(kind, f"({other} {'<' if name == 'min' else '>'} {one} ? {other} : {one})")
        self.kind(best, node)
        return best


def _of_known(name: str, arguments: Sequence[Value]) -> Value:
    """Python's own result of a function of known values; ``...``: they are not known, or it has none."""
    module, _, function = name.rpartition(".")
    if not is_known(arguments) or not (name in _OF_KNOWN or module == "math"):
        return ...
    try:
        value = getattr(math if module else builtins, function)(*arguments)
    except (ValueError, TypeError, ArithmeticError, AttributeError):
        return ...  # the error is reported where the function runs
    return value if is_known(value) and fits(value) else ...
