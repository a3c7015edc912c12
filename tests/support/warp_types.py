"""Plug-in of mypy for Warp: what runs as a kernel is Warp's to check, not mypy's.

Warp compiles the body of a ``@wp.func`` or ``@wp.kernel`` from its syntax tree, by rules that are not Python's: operators of
vectors, conversions of numbers, ``wp.tid()``. So mypy sees neither body nor signature: each such function is declared as the
``wp.Function`` or ``wp.Kernel`` that the decorator makes of it.

Warp's own types leave two things open, which are closed here: ``wp.array2d`` and its like are names for ``wp.array`` with more
dimensions, not further classes; and an array that is made gets the type of elements that its place asks for, else any.
"""

from __future__ import annotations

from collections.abc import Callable

from mypy.nodes import (
    AssignmentStmt,
    CallExpr,
    ClassDef,
    Decorator,
    FuncDef,
    IfStmt,
    MemberExpr,
    MypyFile,
    NameExpr,
    Statement,
    TempNode,
    WithStmt,
)
from mypy.plugin import AnalyzeTypeContext, FunctionContext, Plugin
from mypy.types import AnyType, Instance, Type, TypeOfAny, UnboundType, UninhabitedType, get_proper_type

MADE = {"func": "Function", "func_native": "Function", "kernel": "Kernel"}
"""Class of what each decorator makes."""
ARRAY = "warp._src.types.array"


class WarpTypes(Plugin):
    def get_additional_deps(self, file: MypyFile) -> list[tuple[int, str, int]]:
        """Take kernels and functions out of a module that was just parsed; the result, further imports, is empty."""
        if not file.fullname.startswith("warp."):
            _declare(file.defs)
        return []

    def get_type_analyze_hook(self, fullname: str) -> Callable[[AnalyzeTypeContext], Type] | None:
        return _array if fullname in {f"{ARRAY}{count}d" for count in range(1, 5)} else None

    def get_function_hook(self, fullname: str) -> Callable[[FunctionContext], Type] | None:
        return _made if fullname == ARRAY else None


def _declare(statements: list[Statement]) -> None:
    """Replace every ``@wp.func def name(...): ...`` by ``name: wp.Function``, within functions too."""
    statements[:] = [_declared(statement) for statement in statements]
    for statement in statements:
        inner = statement.func if isinstance(statement, Decorator) else statement
        if isinstance(inner, FuncDef | WithStmt):
            _declare(inner.body.body)
        elif isinstance(inner, ClassDef):
            _declare(inner.defs.body)
        elif isinstance(inner, IfStmt):
            for block in (*inner.body, *filter(None, [inner.else_body])):
                _declare(block.body)


def _declared(statement: Statement) -> Statement:
    if not isinstance(statement, Decorator):
        return statement
    for decorator in statement.original_decorators:
        called = decorator.callee if isinstance(decorator, CallExpr) else decorator
        if isinstance(called, MemberExpr) and isinstance(called.expr, NameExpr) and called.name in MADE:
            kind = UnboundType(f"{called.expr.name}.{MADE[called.name]}", line=statement.line, column=statement.column)
            nothing = TempNode(AnyType(TypeOfAny.special_form), no_rhs=True)
            declared = AssignmentStmt([NameExpr(statement.name)], nothing, kind, new_syntax=True)
            for node in (declared, *declared.lvalues, nothing):
                node.set_line(statement)
            return declared
    return statement


def _array(context: AnalyzeTypeContext) -> Type:
    kind = context.type.args[0] if context.type.args else AnyType(TypeOfAny.from_omitted_generics)
    return context.api.named_type(ARRAY, [context.api.analyze_type(kind), context.api.named_type("builtins.int", [])])


def _made(context: FunctionContext) -> Type:
    made = get_proper_type(context.default_return_type)
    if isinstance(made, Instance) and isinstance(get_proper_type(made.args[0]), UninhabitedType):
        return made.copy_modified(args=[AnyType(TypeOfAny.special_form), *made.args[1:]])
    return made


def plugin(version: str) -> type[Plugin]:
    return WarpTypes
