"""The body of one function in C++: what its variables are follows from all that is assigned to them."""

from __future__ import annotations

import ast
from collections.abc import Callable, Sequence
from typing import Any

from racer.rewards.translation.calls import Calls
from racer.rewards.translation.expression_values import (
    C_TYPES,
    Constant,
    ItemList,
    Outside,
    Thing,
    Value,
    codes,
    described,
    flat,
    joined,
    parenthesised,
    rebuilt,
    shape_of,
)
from racer.rewards.translation.prelude import NO_RESULT
from racer.rewards.translation.program import Program

_MOST_PASSES = 16
_DEEPEST = 20
"""Functions that call each other."""
_Function = ast.FunctionDef | ast.Lambda


class Body(Calls):
    """Translates a function for arguments of certain types.

    Args:
        program: What all functions share.
        node: The function.
        arguments: Types of its arguments, by name.
        parent: The function in which it is defined, None where that is the file.

    Attributes:
        result: Type of its result; None: it gives none.
        text: Its C++ body.
    """

    def __init__(self, program: Program, node: _Function, arguments: dict[str, Any], parent: Body | None) -> None:
        self.program, self.node, self.parent = program, node, parent
        self.arguments = arguments
        self.label = program.number()
        self.local = _local(node)
        self.slots: dict[str, Any] = dict(arguments)
        self.flagged: set[str] = set()
        self.result: Any = None
        self.text = self._passes()

    def _passes(self) -> list[str]:
        """Translate until the types of all variables stay what they are."""
        for _ in range(_MOST_PASSES):
            before = (dict(self.slots), set(self.flagged), self.result)
            self.lines: list[str] = []
            self.overlay: list[dict[str, Value]] = []
            self.assigned = set(self.arguments)
            self.may_fail = False
            if isinstance(self.node, ast.Lambda):
                self._give(self.expression(self.node.body), self.node.body)
                ended = True
            else:
                ended = self.block(self.node.body)
            if not ended:
                self._nothing(self.node)
            if before == (self.slots, self.flagged, self.result):
                return [*self._declarations(), *self.lines]
        raise Outside(self.node, "a variable whose type keeps changing")

    def _declarations(self) -> list[str]:
        lines = []
        for name, shape in self.slots.items():
            given = [f"a_{each}" for each in self.variables(name, shape)]
            widths = flat(self.arguments[name]) if name in self.arguments else []
            for place, (kind, variable) in enumerate(zip(flat(shape), self.variables(name, shape), strict=True)):
                first = f"({C_TYPES[kind]}){given[place]}" if widths else "0"
                lines.append(f"{C_TYPES[kind]} {variable} = {first};")
        return [*lines, *(f"bool {self.flag(name)} = false;" for name in sorted(self.flagged))]

    @property
    def parameters(self) -> str:
        """The C++ parameters."""
        return ", ".join(
            f"{C_TYPES[kind]} a_{variable}"
            for name, shape in self.arguments.items()
            for kind, variable in zip(flat(shape), self.variables(name, shape), strict=True)
        )

    @property
    def returns(self) -> str:
        """The C++ type of the result."""
        if isinstance(self.result, str):
            return C_TYPES[self.result]
        return self.program.struct(flat(self.result)) if flat(self.result) else "bool"

    # calls of functions of the file

    def apply(self, function: Thing, arguments: Sequence[Value], named: dict[str, Value], node: ast.AST) -> Value:
        """The result of a function of the file, which is translated for the types of these arguments."""
        given = self._matched(function, arguments, named, node)
        if function.node in self.program.running or len(self.program.running) > _DEEPEST:
            raise Outside(node, f"{function.name}(), which calls itself")
        for value in given.values():
            _check_kept(value, node)
        shapes = {name: shape_of(value) for name, value in given.items()}
        values = ", ".join(code for name, value in given.items() for code in codes(value, shapes[name]))
        key = (function.node, tuple(shapes.items()))
        if key in self.program.known:
            called, result, returns = self.program.known[key]
        else:
            self.program.running.append(function.node)
            body = Body(self.program, function.node, shapes, function.scope)
            self.program.running.pop()
            result, returns = body.result, body.returns
            text = f"[&]({body.parameters}) -> {returns} {{ {' '.join(body.text)} }}"
            if function.scope is None and not any(map(_sees, given.values())):
                called = f"f{body.label}"
                self.program.functions.append(f"auto {called} = {text};")
                self.program.known[key] = (called, result, returns)
            else:
                called = text  # it sees the variables of the function around it, and so stays where it is called
        self.may_fail = True
        if result is None or not flat(result):
            self.emit(f"{called}({values});")
            return self.program.wrap(None, node) if result is None else rebuilt(result, [])
        name = self.fresh()
        self.emit(f"const {returns} {name} = {called}({values});")
        if isinstance(result, str):
            return rebuilt(result, [name])
        return rebuilt(result, [f"{name}.a{place}" for place in range(len(flat(result)))])

    def _matched(
        self, function: Thing, arguments: Sequence[Value], named: dict[str, Value], node: ast.AST
    ) -> dict[str, Value]:
        """The arguments of a call by the names of the function's parameters."""
        found = function.node.args
        if found.vararg or found.kwarg:
            raise Outside(function.node, "a function with * or **")
        if getattr(function.node, "decorator_list", None):
            raise Outside(function.node, "a decorated function")
        names = [each.arg for each in (*found.posonlyargs, *found.args)]
        given = dict(zip(names, arguments, strict=False))
        every = [*names, *(each.arg for each in found.kwonlyargs)]
        if len(arguments) > len(names) or set(named) - set(every) or set(named) & set(given):
            raise Outside(node, f"a call of {function.name}() that does not fit its parameters")
        given |= named
        defaults = dict(zip(names[len(names) - len(found.defaults) :], found.defaults, strict=True))
        defaults |= {each.arg: value for each, value in zip(found.kwonlyargs, found.kw_defaults, strict=True) if value}
        for name, default in defaults.items():
            if name not in given:
                given[name] = self.program.wrap(self.constant(default), default)
        if missing := [name for name in every if name not in given]:
            raise Outside(node, f"a call of {function.name}() without {missing[0]}")
        return {name: given[name] for name in every}

    # statements

    def block(self, statements: Sequence[ast.stmt]) -> bool:
        """Translate statements; returns whether none behind them is reached."""
        for statement in statements:
            method: Callable[[Any], bool | None] | None = getattr(self, f"_on_{type(statement).__name__}", None)
            if method is None:
                raise Outside(statement, _TOLD.get(type(statement).__name__, f"a {type(statement).__name__} statement"))
            if method(statement):
                return True
            self.check()
        return False

    def _on_Pass(self, node: ast.Pass) -> None:
        pass

    def _on_Expr(self, node: ast.Expr) -> None:
        if not isinstance(node.value, ast.Constant):
            self.expression(node.value)

    def _on_Import(self, node: ast.Import) -> None:
        for alias in node.names:
            name = alias.asname or alias.name.partition(".")[0]
            self.store(name, Thing("module", alias.name if alias.asname else name), node)

    def _on_FunctionDef(self, node: ast.FunctionDef) -> None:
        self.store(node.name, Thing("function", node.name, node, self), node)

    def _on_Assign(self, node: ast.Assign) -> None:
        if all(isinstance(target, ast.Name) for target in node.targets):
            value = self._value(node.value)
        else:
            value = self.hold(self._value(node.value))
        for target in node.targets:
            self.unpack(target, value, self.store)

    def _value(self, node: ast.expr) -> Value:
        return self._Lambda(node) if isinstance(node, ast.Lambda) else self.expression(node)

    def _on_AnnAssign(self, node: ast.AnnAssign) -> None:
        if node.value is not None:
            self.unpack(node.target, self.expression(node.value), self.store)

    def _on_AugAssign(self, node: ast.AugAssign) -> None:
        if not isinstance(node.target, ast.Name):
            raise Outside(node, "a list or an object that is changed")
        old = self.lookup(node.target.id, node)
        self.store(node.target.id, self.binary(node.op, old, self.expression(node.value), node), node)

    def store(self, name: str, value: Value, node: ast.AST) -> None:
        """Assign a value to a local variable."""
        _check_kept(value, node)
        shape = shape_of(value)
        old: Any = self.slots.get(name)
        new = shape if old is None else joined(old, shape)
        if new is None:
            raise Outside(node, f"{name}, which is {described(old)} and then {described(shape)}")
        self.slots[name] = new
        places, values = self.variables(name, new), codes(value, new)
        if len(places) > 1:  # an item may be worked out from another one
            values = [
                code if code.startswith("t") else self._kept(kind, code)
                for kind, code in zip(flat(new), values, strict=True)
            ]
        self.lines += [f"{place} = {code};" for place, code in zip(places, values, strict=True)]
        if name in self.flagged:
            self.emit(f"{self.flag(name)} = true;")
        self.assigned.add(name)

    def _kept(self, kind: str, code: str) -> str:
        name = self.fresh()
        self.emit(f"const {C_TYPES[kind]} {name} = {code};")
        return name

    def _on_Return(self, node: ast.Return) -> bool:
        if node.value is None:
            self._nothing(node)
        else:
            value = self.expression(node.value)
            if isinstance(value, Constant) and value.value is None:
                self._nothing(node)
            else:
                self._give(value, node)
        return True

    def _nothing(self, node: ast.AST) -> None:
        """The result None: an error of reward_function, which some calls of other functions may well give."""
        if self.result is not None:
            if len(self.program.running) > 1:  # not reward_function itself
                raise Outside(node, f"a function that returns {described(self.result)} or None")
            self.emit(f"py_fail({self.at(node)} + {NO_RESULT});")
        self.emit("return {};")

    def _give(self, value: Value, node: ast.AST) -> None:
        _check_kept(value, node)
        if _sees(value):
            raise Outside(node, "a function that returns a function")
        shape = shape_of(value)
        result = shape if self.result is None else joined(self.result, shape)
        if result is None:
            raise Outside(node, f"a function that returns {described(self.result)} or {described(shape)}")
        self.result = result
        values = ", ".join(codes(value, result))
        if isinstance(result, str):
            self.emit(f"return {values};")
        else:
            self.emit(f"return {self.returns}{{{values}}};" if values else "return {};")

    def _on_If(self, node: ast.If) -> bool:
        test = self.condition(node.test)
        if test.constant is not None:
            return self.block(node.body if test.constant else node.orelse)
        if self.may_fail:
            test = self.numeric(self.hold(test), node)
            self.check()
        before = set(self.assigned)
        self.emit(f"if {parenthesised(test.code)} {{")
        first = self.block(node.body)
        left, self.assigned = self.assigned, set(before)
        self.emit("} else {")
        second = self.block(node.orelse)
        self.emit("}")
        right = self.assigned
        self.assigned = right if first else left if second else left & right
        return first and second

    def _on_For(self, node: ast.For) -> None:
        if node.orelse:
            raise Outside(node, "for … else")
        before = set(self.assigned)

        def body(item: Value) -> None:
            self.unpack(node.target, self.hold(item), self.store)
            self.check()
            self.block(node.body)

        self.each(self.expression(node.iter), node, body)
        self.assigned = before

    def _on_While(self, node: ast.While) -> bool:
        if node.orelse:
            raise Outside(node, "while … else")
        before = set(self.assigned)
        self.emit("while (true) {")
        self.emit(self.round(node))
        test = self.condition(node.test)
        if test.constant is None:
            test = self.numeric(self.hold(test), node)
            self.check()
        if test.constant is not True:
            self.emit(f"if (!{test.code}) break;")
        self.block(node.body)
        self.emit("}")
        self.assigned = before
        return test.constant is True and not any(_breaks(each) for each in node.body)

    def _on_Break(self, node: ast.Break) -> bool:
        self.emit("break;")
        return True

    def _on_Continue(self, node: ast.Continue) -> bool:
        self.emit("continue;")
        return True


def _check_kept(value: Value, node: ast.AST) -> None:
    """Refuse what holds good only where it is written."""
    if isinstance(value, Thing) and value.kind == "iterated":
        raise Outside(node, f"{value.name} that is kept for later")
    for item in value.items if isinstance(value, ItemList) else ():
        _check_kept(item, node)


def _sees(value: Value) -> bool:
    """Whether a value is, or holds, a function that sees the variables of the function around it."""
    if isinstance(value, ItemList):
        return any(map(_sees, value.items))
    return isinstance(value, Thing) and value.scope is not None


def _breaks(node: ast.AST) -> bool:
    """Whether a statement of a loop's body leaves that loop."""
    if isinstance(node, ast.Break):
        return True
    if isinstance(node, ast.For | ast.While | ast.FunctionDef | ast.Lambda):
        return False
    return any(_breaks(child) for child in ast.iter_child_nodes(node))


def _local(node: _Function) -> set[str]:
    """Names of a function's own variables."""
    arguments = node.args
    names = {each.arg for each in (*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs)}
    waiting: list[ast.AST] = list(node.body) if isinstance(node, ast.FunctionDef) else []
    while waiting:
        each = waiting.pop()
        if isinstance(each, ast.Nonlocal):
            raise Outside(each, "nonlocal")
        if isinstance(each, ast.Global):
            raise Outside(each, f"the global variable {each.names[0]}, which keeps its value")
        if isinstance(each, ast.FunctionDef | ast.ClassDef):
            names.add(each.name)
            continue
        if isinstance(each, ast.Lambda | ast.ListComp | ast.GeneratorExp | ast.SetComp | ast.DictComp):
            continue
        if isinstance(each, ast.Name) and isinstance(each.ctx, ast.Store):
            names.add(each.id)
        if isinstance(each, ast.Import | ast.ImportFrom):
            names |= {alias.asname or alias.name.partition(".")[0] for alias in each.names}
        waiting += ast.iter_child_nodes(each)
    return names


_TOLD = {
    "Try": "try and except",
    "With": "with",
    "Raise": "raise",
    "Assert": "assert",
    "Delete": "del",
    "ClassDef": "a class",
    "Match": "match",
    "ImportFrom": "an import inside a function",
}
