"""The body of a function in C++, whose variables' shapes follow from all that is assigned to them, and of the module around it."""

from __future__ import annotations

import ast
import math
from collections.abc import Callable, Sequence
from typing import Any

from racer.rewards.translation.calls import BUILTINS, Calls
from racer.rewards.translation.expression_values import (
    C_TYPES,
    Function,
    Known,
    Number,
    Outside,
    Series,
    Value,
    flat,
    is_known,
    kept,
    rebuilt,
    shape_of,
)
from racer.rewards.translation.prelude import CONSTANTS, NO_RESULT

_MOST_PASSES = 16
_MOST_NAMES = 50_000
_DEEPEST = 20
"""Functions that call each other."""
_NO_RESULT = Known("result", "nothing")
_Function = ast.FunctionDef | ast.Lambda


class Body(Calls):
    """Translates a function for arguments of certain shapes.

    Args:
        program: What all functions share.
        node: The function.
        arguments: Shapes of its arguments, by name.
        parent: The function or module in which it is defined.

    Attributes:
        result: Shape of its result.
        text: Its C++ body, which gives references to the numbers of its result their values.
    """

    def __init__(self, program: Module, node: _Function, arguments: dict[str, Value], parent: Any) -> None:
        self.program, self.node, self.parent, self.arguments = program, node, parent, arguments
        self.label = program.number()
        if self.label > _MOST_NAMES:  # functions that call functions many times over
            raise Outside(node, "a function that is too long with all that it calls")
        self.local = _local(node)
        self.slots = dict(arguments)
        self.flagged = set()
        self.result: Value = _NO_RESULT
        self.text = self._passes()

    def _passes(self) -> list[str]:
        """Translate until the shapes of all variables stay what they are."""
        for _ in range(_MOST_PASSES):
            before = repr((self.slots, sorted(self.flagged), self.result))
            self.lines, self.assigned, self.may_fail = [], set(self.arguments), False
            if isinstance(self.node, ast.Lambda):
                self._give(self.expression(self.node.body), self.node.body)
            elif not self.block(self.node.body):
                self._give(None, self.node)
            if before == repr((self.slots, sorted(self.flagged), self.result)):
                return [*self._declarations(), *self.lines]
        raise Outside(self.node, "a variable whose type keeps changing")

    def _declarations(self) -> list[str]:
        lines = [f"bool {self.flag(name)} = false;" for name in sorted(self.flagged)]
        for name, shape in self.slots.items():
            for kind, place in zip(flat(shape), self.places(name, shape), strict=True):
                first = f"({C_TYPES[kind]})a_{place}" if name in self.arguments else "0"
                lines.append(f"{C_TYPES[kind]} {place} = {first};")
        return lines

    @property
    def parameters(self) -> str:
        """The C++ parameters: the numbers of the arguments, and references to those of the result."""
        pairs = [
            (kind, f"a_{place}")
            for name, shape in self.arguments.items()
            for kind, place in zip(flat(shape), self.places(name, shape), strict=True)
        ]
        results = [(kind, f"&r{self.label}_{place}") for place, kind in enumerate(flat(self.result))]
        return ", ".join(f"{C_TYPES[kind]} {name}" for kind, name in (*pairs, *results))

    # calls of functions of the file

    def apply(self, function: Function, arguments: Sequence[Value], named: dict[str, Value], node: ast.AST) -> Value:
        """The result of a function of the file, which is translated for the shapes of these arguments."""
        try:
            bound = function.signature.bind(*arguments, **named)
        except TypeError:
            raise Outside(node, f"a call of {function.name}() that does not fit its parameters") from None
        bound.apply_defaults()
        values = bound.arguments
        if function.node in self.program.running or len(self.program.running) > _DEEPEST:
            raise Outside(node, f"{function.name}(), which calls itself")
        shapes = {name: shape_of(value) for name, value in values.items()}
        key = function.node, repr(shapes)
        if key in self.program.translated:
            called, result = self.program.translated[key]
        else:
            self.program.running.append(function.node)
            body = Body(self.program, function.node, shapes, function.scope)
            self.program.running.pop()
            called, result = f"[&]({body.parameters}) {{ {' '.join(body.text)} }}", body.result
            if isinstance(function.scope, Module) and not any(map(_sees, values.values())):
                self.program.functions.append(f"auto f{body.label} = {called};")
                called = f"f{body.label}"
                self.program.translated[key] = called, result
            # else it sees the variables of the function around it, and so stays where it is called
        names = self.variables(result)
        codes = [code for name, value in values.items() for code in self.codes(value, shapes[name])]
        self.emit(f"{called}({', '.join([*codes, *names])});")
        self.may_fail = True
        return rebuilt(result, iter(names))

    # statements

    def block(self, statements: Sequence[ast.stmt]) -> bool:
        """Translate statements; returns whether none behind them is reached."""
        for statement in statements:
            method: Callable[[Any], bool | None] | None = getattr(self, f"_on_{type(statement).__name__}", None)
            if method is None:
                raise Outside(statement, _REFUSED.get(type(statement).__name__, "a statement that is not translated"))
            if method(statement):
                return True
            self.check()
        return False

    def _on_Pass(self, node: ast.Pass) -> None:
        pass

    def _on_Expr(self, node: ast.Expr) -> None:
        if not isinstance(node.value, ast.Constant):
            self.expression(node.value)

    def _on_Import(self, node: ast.Import | ast.ImportFrom) -> None:
        for name, value in imported(node).items():
            self.store(name, value, node)

    _on_ImportFrom = _on_Import

    def _on_FunctionDef(self, node: ast.FunctionDef) -> None:
        self.store(node.name, self.function(node.name, node, self), node)

    def _on_Assign(self, node: ast.Assign) -> None:
        value = self.expression(node.value)
        if not all(isinstance(target, ast.Name) for target in node.targets):
            value = self.hold(value)
        for target in node.targets:
            self.unpack(target, value, self.store)

    def _on_AnnAssign(self, node: ast.AnnAssign) -> None:
        if node.value is not None:
            self.unpack(node.target, self.expression(node.value), self.store)

    def _on_AugAssign(self, node: ast.AugAssign) -> None:
        old = self.lookup(node.target.id, node) if isinstance(node.target, ast.Name) else []
        if isinstance(old, list | Series):
            raise Outside(node, "a list or an object that is changed")
        self.unpack(node.target, self.binary(node.op, old, self.expression(node.value), node), self.store)

    def store(self, name: str, value: Value, node: ast.AST) -> None:
        """Assign a value to a local variable."""
        shape = kept(value, node)
        if name in self.slots:
            shape = self.join(self.slots[name], shape, node, f"{name}, which is {{}} and then {{}}")
        self.slots[name] = shape
        places, codes = self.places(name, shape), self.codes(value, shape)
        if len(places) > 1:  # an item may be worked out from another one
            codes = [self.variable(*each) for each in zip(flat(shape), codes, strict=True)]
        self.emit(*map("{} = {};".format, places, codes))
        if name in self.flagged:
            self.emit(f"{self.flag(name)} = true;")
        self.assigned.add(name)

    def _on_Return(self, node: ast.Return) -> bool:
        self._give(None if node.value is None else self.expression(node.value), node)
        return True

    def _give(self, value: Value, node: ast.AST) -> None:
        """Leave the function with a result; None is an error of reward_function, which some calls of it may well give."""
        if value is None and len(self.program.running) == 1:
            self.emit(f"py_fail({self.at(node, NO_RESULT)});", "return;")
            return
        if _sees(value):
            raise Outside(node, "a function that returns a function")
        shape = kept(value, node)
        if self.result is not _NO_RESULT:
            shape = self.join(self.result, shape, node, "a function that returns {} or {}")
        self.result = shape
        self.emit(
            *(f"r{self.label}_{place} = {code};" for place, code in enumerate(self.codes(value, shape))), "return;"
        )

    def _tested(self, node: ast.expr) -> Value:
        """Whether a statement's condition is true, after a check of its errors."""
        test = self.condition(node)
        if self.may_fail:
            test = self.hold(test)
            self.check()
        return test

    def _on_If(self, node: ast.If) -> bool:
        test = self._tested(node.test)
        if not isinstance(test, Number):
            return self.block(node.body if test else node.orelse)
        before = set(self.assigned)
        self.emit(f"if ((bool){test.code}) {{")
        first = self.block(node.body)
        left, self.assigned = self.assigned, before
        self.emit("} else {")
        second = self.block(node.orelse)
        self.emit("}")
        self.assigned = self.assigned if first else left if second else left & self.assigned
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
        self.emit("while (true) {", self.round(node))
        test = self._tested(node.test)
        if test is not True:
            self.emit(f"if (!{self.code(test, 'bool')}) break;")
        self.block(node.body)
        self.emit("}")
        self.assigned = before
        return test is True and not any(map(_breaks, node.body))

    def _on_Break(self, node: ast.Break | ast.Continue) -> bool:
        self.emit(f"{type(node).__name__.lower()};")
        return True

    _on_Continue = _on_Break


class Module(Body):
    """Translates the statements of a module, whose names have to be constants or functions.

    Args:
        tree: Its syntax tree.

    Attributes:
        names: What its names stand for; :class:`Outside` where that is not translated.
        tables: Names of the C++ arrays of constant lists, by their text.
        texts: Numbers of the texts.
        functions: C++ of the functions that are called, in order.
        translated: C++ name and shape of the result of each function, by its node and the shapes of its arguments.
        running: The functions that are being translated, innermost last.
        notes: What is left out, a line each.
    """

    def __init__(self, tree: ast.Module) -> None:
        self.program, self.parent, self.label = self, None, 0
        self.lines, self.local, self.may_fail = [], set(), False
        self.names: dict[str, Value] = {}
        self.tables: dict[str, str] = {}
        self.texts: dict[str, int] = {}
        self.functions: list[str] = []
        self.translated: dict[Any, tuple[str, Value]] = {}
        self.running: list[ast.AST] = []
        self.notes: dict[str, None] = {}
        self._starred: set[str] = set()
        self._count = 0
        for statement in tree.body:
            _check_harmless(statement)
            try:
                self._define(statement)
            except Outside as outside:
                if isinstance(statement, ast.Import | ast.ImportFrom):
                    raise
                nodes = [each for each in ast.walk(statement) if isinstance(each, ast.Name)]
                stored = [each.id for each in nodes if not isinstance(each.ctx, ast.Load)]
                name = getattr(statement, "name", "")  # of a function
                self.names |= dict.fromkeys([name] if name else stored, outside)
        for node in ast.walk(tree):
            for name in node.names if isinstance(node, ast.Global) else ():
                self.names[name] = Outside(node, f"the global variable {name}, which keeps its value")
            if isinstance(node, ast.Name | ast.arg) and getattr(node, "id", getattr(node, "arg", "")).startswith("py_"):
                raise Outside(node, "a name that begins with py_")

    def number(self) -> int:
        """A number that no other name has."""
        self._count += 1
        return self._count

    def lookup(self, name: str, node: ast.AST) -> Value:
        """The value of a name of the module, or of one that is built in."""
        if name not in self.names and name not in BUILTINS:
            raise Outside(node, f"the name {name}")
        value = self.names.get(name, Known("builtin", name))
        if isinstance(value, Outside):
            raise Outside(node, value.reason)
        return value

    def _define(self, statement: ast.stmt) -> None:
        if isinstance(statement, ast.ClassDef):
            self.names[statement.name] = Outside(statement, f"an object of the class {statement.name}")
        elif isinstance(
            statement, ast.FunctionDef | ast.Import | ast.ImportFrom | ast.Assign | ast.AnnAssign | ast.Expr
        ):
            self.block([statement])
            if self.lines:
                self.lines = []
                raise Outside(statement, "a value that is worked out when the module is imported")
        else:
            raise Outside(statement, "a name that such a statement of the module sets")

    def _on_ImportFrom(self, node: ast.Import | ast.ImportFrom) -> None:
        self._on_Import(node)
        self._starred |= set(imported(node)) if node.names[0].name == "*" else set()

    def store(self, name: str, value: Value, node: ast.AST) -> None:
        """Give a name of the module its value, once."""
        if not is_known(value) and not isinstance(value, Function | Known):
            raise Outside(node, "a value that is worked out when the module is imported")
        if name in self.names and name not in self._starred:
            value = Outside(node, f"{name}, which the module sets more than once")
        self._starred.discard(name)
        self.names[name] = value


def imported(statement: ast.Import | ast.ImportFrom) -> dict[str, Value]:
    """The names that an import defines."""
    if isinstance(statement, ast.Import):
        pairs = [(each.asname or each.name.partition(".")[0], each) for each in statement.names]
        return {name: Known("module", each.name if each.asname else name) for name, each in pairs}
    names = {each.asname or each.name: each.name for each in statement.names}
    if "*" in names:
        if statement.module != "math":
            raise Outside(statement, f"from {statement.module} import *")
        names = {name: name for name in vars(math) if not name.startswith("_")}
    is_math = statement.module == "math"
    return {
        name: CONSTANTS[each] if is_math and each in CONSTANTS else Known("builtin", f"{statement.module}.{each}")
        for name, each in names.items()
    }


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


def _sees(value: Value) -> bool:
    """Whether a value is, or holds, a function that sees the variables of the function around it."""
    if isinstance(value, list | tuple):
        return any(map(_sees, value))
    return isinstance(value, Function) and not isinstance(value.scope, Module)


def _breaks(node: ast.AST) -> bool:
    """Whether a statement of a loop's body leaves that loop."""
    if isinstance(node, ast.For | ast.While | ast.FunctionDef | ast.Lambda):
        return False
    return isinstance(node, ast.Break) or any(map(_breaks, ast.iter_child_nodes(node)))


def _local(node: _Function) -> set[str]:
    """Names of a function's own variables."""
    names = {each.arg for each in ast.walk(node.args) if isinstance(each, ast.arg)}
    nodes: list[ast.AST] = list(node.body) if isinstance(node, ast.FunctionDef) else []
    for each in nodes:
        if isinstance(each, ast.Nonlocal | ast.Global):
            kind = "nonlocal" if isinstance(each, ast.Nonlocal) else "global"
            raise Outside(each, f"the {kind} variable {each.names[0]}, which keeps its value")
        if isinstance(each, ast.FunctionDef | ast.ClassDef):
            names.add(each.name)
        elif not isinstance(each, ast.Lambda | ast.ListComp | ast.GeneratorExp | ast.SetComp | ast.DictComp):
            if isinstance(each, ast.Name) and isinstance(each.ctx, ast.Store):
                names.add(each.id)
            elif isinstance(each, ast.Import | ast.ImportFrom):
                names |= set(imported(each))
            nodes += ast.iter_child_nodes(each)
    return names


_REFUSED = {
    "Try": "try and except",
    "With": "with",
    "Raise": "raise",
    "Assert": "assert",
    "Delete": "del",
    "ClassDef": "a class",
    "Match": "match",
}
