"""Plug-in of mypy for Warp: what runs as a kernel is Warp's to check, not mypy's.

Warp compiles the body of a ``@wp.func`` or ``@wp.kernel`` from its syntax tree, by rules that are not Python's: operators of
vectors, conversions of numbers, ``wp.tid()``. So mypy sees neither body nor signature: each such function is declared as the
``wp.Function`` or ``wp.Kernel`` that the decorator makes of it. A term that is ``@composed`` of others has no body at all.

The types of Warp and Newton leave four things open, which are closed here:

- ``wp.array2d`` and its like are names for ``wp.array`` with more dimensions, not further classes.
- ``wp.vec3f`` and its like are another class in Warp's stub than in its source; the one of the source has operators.
- A new array has the elements that its place asks for, else any.
- The arrays of Newton's models and states are declared as optional, although ``finalize()`` and ``state()`` make them all.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

from mypy import nodes, types
from mypy.plugin import AnalyzeTypeContext, AttributeContext, FunctionContext, Plugin, ReportConfigContext
from mypy.types_utils import remove_optional

MADE = {"func": "Function", "func_native": "Function", "kernel": "Kernel", "composed": "Function"}
"""Class of what each decorator makes."""
KERNEL = re.compile(rb"@(\w+\.(func|func_native|kernel)|composed)\b")
ARRAY = "warp._src.types.array"
COPIED = re.compile(r"warp\.((vec[234]|mat(22|33|44)|quat|transform)f)")
FILLED = ("newton._src.sim.model.Model.", "newton._src.sim.state.State.")


class WarpTypes(Plugin):
    def get_additional_deps(self, file: nodes.MypyFile) -> list[tuple[int, str, int]]:
        """Take kernels and functions out of a module that was just parsed; the result, further imports, is empty."""
        if not file.fullname.startswith("warp."):
            _declare(file.defs)
        return []

    def report_config_data(self, ctx: ReportConfigContext) -> bool | None:
        """Never the same for a module with kernels: mypy may parse a cached module again without the method above."""
        own = ctx.path.endswith(".py") and "site-packages" not in ctx.path
        return ctx.is_check if own and KERNEL.search(Path(ctx.path).read_bytes()) else None

    def get_type_analyze_hook(self, fullname: str) -> Callable[[AnalyzeTypeContext], types.Type] | None:
        if copied := COPIED.fullmatch(fullname):
            return lambda context: context.api.named_type(f"warp._src.types.{copied[1]}", [])
        return _array if fullname in {f"{ARRAY}{count}d" for count in range(1, 5)} else None

    def get_function_hook(self, fullname: str) -> Callable[[FunctionContext], types.Type] | None:
        return _made if fullname == ARRAY else None

    def get_attribute_hook(self, fullname: str) -> Callable[[AttributeContext], types.Type] | None:
        return _filled if fullname.startswith(FILLED) else None


def _declare(statements: list[nodes.Statement]) -> None:
    """Replace every ``@wp.func def name(...): ...`` by ``name: wp.Function``, within functions too."""
    statements[:] = [_declared(statement) for statement in statements]
    for statement in statements:
        inner = statement.func if isinstance(statement, nodes.Decorator) else statement
        if isinstance(inner, nodes.FuncDef | nodes.WithStmt):
            _declare(inner.body.body)
        elif isinstance(inner, nodes.ClassDef):
            _declare(inner.defs.body)
        elif isinstance(inner, nodes.IfStmt):
            for block in (*inner.body, *filter(None, [inner.else_body])):
                _declare(block.body)


def _declared(statement: nodes.Statement) -> nodes.Statement:
    if not isinstance(statement, nodes.Decorator):
        return statement
    for decorator in statement.original_decorators:
        called = decorator.callee if isinstance(decorator, nodes.CallExpr) else decorator
        if isinstance(called, nodes.MemberExpr) and isinstance(called.expr, nodes.NameExpr) and called.name in MADE:
            module = called.expr.name
        elif isinstance(called, nodes.NameExpr) and called.name == "composed":
            module = "wp"
        else:
            continue
        kind = types.UnboundType(f"{module}.{MADE[called.name]}", line=statement.line)
        nothing = nodes.TempNode(types.AnyType(types.TypeOfAny.special_form), no_rhs=True)
        declared = nodes.AssignmentStmt([nodes.NameExpr(statement.name)], nothing, kind, new_syntax=True)
        for node in (declared, *declared.lvalues, nothing):
            node.set_line(statement)
        return declared
    return statement


def _array(context: AnalyzeTypeContext) -> types.Type:
    api, supplied = context.api, context.type.args
    element = api.analyze_type(supplied[0]) if supplied else types.AnyType(types.TypeOfAny.from_omitted_generics)
    return api.named_type(ARRAY, [element, api.named_type("builtins.int", [])])


def _made(context: FunctionContext) -> types.Type:
    made = types.get_proper_type(context.default_return_type)
    if isinstance(made, types.Instance) and isinstance(types.get_proper_type(made.args[0]), types.UninhabitedType):
        return made.copy_modified(args=[types.AnyType(types.TypeOfAny.special_form), *made.args[1:]])
    return made


def _filled(context: AttributeContext) -> types.Type:
    return context.default_attr_type if context.is_lvalue else remove_optional(context.default_attr_type)


def plugin(version: str) -> type[Plugin]:
    return WarpTypes
