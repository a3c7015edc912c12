"""Registering functions with Warp without reading them: of the two thousand of Newton and MuJoCo-Warp a training compiles a tenth.

At the import of a function Warp parses its source, and looks in it for the functions that it calls. The first is needed only once the
function is compiled, the second only where a module is imported twice, as in a notebook. Together they take half of the imports' time.
"""

from __future__ import annotations

import ast
import inspect
import textwrap
from collections.abc import Callable
from typing import Any

from warp._src import codegen, context


def register_lazily() -> None:
    """Have Warp parse what is registered from now on at its first use. Without effect on a Warp that is built otherwise."""
    adjoint, module = codegen.Adjoint, context.Module
    needed = (
        (adjoint, "_try_extract_function_source"),
        (adjoint, "extract_function_source"),
        (module, "_find_references"),
    )
    if not all(hasattr(owner, name) for owner, name in needed) or adjoint.extract_function_source is _extract:
        return
    _Source.eagerly = adjoint.extract_function_source
    adjoint.extract_function_source = staticmethod(_extract)  # type: ignore[assignment]
    module._find_references = lambda module, adjoint: None  # type: ignore[method-assign]


def _extract(function: Callable[..., Any]) -> tuple[str, int, ast.Module]:
    """In place of ``Adjoint.extract_function_source``: the source, its first line, and a tree that is parsed when it is read."""
    code: Any = getattr(inspect.unwrap(function), "__code__", None)
    if code is None or (found := codegen.Adjoint._try_extract_function_source(code)) is None:
        return _Source.eagerly(function)
    source = textwrap.dedent(found[0])
    return source, found[1], _Source(function, code.co_name, source)


class _Name:
    """A definition of which only the name is known."""

    def __init__(self, name: str) -> None:
        self.name = name


class _Source(ast.Module):
    """A syntax tree that is parsed when it is read for the second time: ``Adjoint`` reads it once for the name alone."""

    eagerly: Callable[[Callable[..., Any]], tuple[str, int, ast.Module]]

    def __init__(self, function: Any = None, name: str = "", source: str = "", **fields: Any) -> None:
        """``fields``: those of a copy, instead of all else."""
        self._function, self._name, self._source = function, name, source
        self._body = fields.get("body")
        self._is_named = self._body is not None
        self.type_ignores = []

    @property
    def body(self) -> list[Any]:  # type: ignore[override]
        if not self._is_named:
            self._is_named = True
            return [_Name(self._name)]
        if self._body is None:
            self._body = self._parsed()
        return self._body

    def _parsed(self) -> list[Any]:
        try:
            body = ast.parse(self._source).body
            if body and isinstance(body[0], ast.FunctionDef) and body[0].name == self._name:
                return body
        except SyntaxError:
            pass
        return _Source.eagerly(self._function)[2].body  # whose end was found by its indentation, and is elsewhere
