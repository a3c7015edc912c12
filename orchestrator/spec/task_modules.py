"""The modules of installed tasks: whether the class that an entry point names can be there. Nothing of a task is imported."""

from __future__ import annotations

import ast
import sys
from functools import lru_cache
from importlib.machinery import ModuleSpec
from pathlib import Path


def module_problem(place: str) -> str | None:
    """Why the class of ``module:Class`` can't be imported, as far as its source says; None where that says nothing.

    What the module does when it is imported is not known here: a rank says it.
    """
    module, _, name = place.partition(":")
    if not name:
        return f"its entry point {place} names no class"
    found: ModuleSpec | None = None
    for count in range(module.count(".") + 1):
        part = ".".join(module.split(".")[: count + 1])
        found = _spec(part, found)
        if found is None:
            return f"there is no module {part}"
    if found is None or not found.has_location or not found.origin or not found.origin.endswith(".py"):
        return None
    try:
        return _source_problem(found.origin, Path(found.origin).stat().st_mtime_ns, name)
    except (OSError, ValueError):  # not a text that Python reads: its import says why
        return None


def _spec(module: str, package: ModuleSpec | None) -> ModuleSpec | None:
    """The specification of a module, found without importing the packages around it."""
    path = package.submodule_search_locations if package else None
    if package and path is None:
        return None
    finders = (finder.find_spec for finder in sys.meta_path if hasattr(finder, "find_spec"))
    return next(filter(None, (find(module, path) for find in finders)), None)


@lru_cache(maxsize=100)
def _source_problem(file: str, changed: int, name: str) -> str | None:
    """The same of a source file, as it was when it ``changed``. Raises OSError, ValueError."""
    source = Path(file).read_bytes()
    try:
        tree = ast.parse(source)
    except SyntaxError as error:
        return f"{file}:{error.lineno or 1}: {type(error).__name__}: {error.msg}"
    nodes = [*ast.walk(tree)]
    bound = {each.name for each in nodes if isinstance(each, ast.ClassDef | ast.FunctionDef)}
    bound |= {each.id for each in nodes if isinstance(each, ast.Name) and isinstance(each.ctx, ast.Store)}
    bound |= {each.asname or each.name for each in nodes if isinstance(each, ast.alias)}
    if name in bound or bound & {"*", "__getattr__"} or b"globals(" in source or b"exec(" in source:
        return None
    return f"{file} has no class {name}"
