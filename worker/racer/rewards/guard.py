"""Checks a reward function before any job starts: its text, its imports and names, and what it does with sample inputs.

It is a guard against mistakes and carelessness, not a sandbox: a determined attacker gets round it. What isolates jobs is in
docs/security.md.
"""

from __future__ import annotations

import ast
import io
import json
import os
import subprocess
import sys
import tokenize
import warnings
from collections.abc import Iterator
from pathlib import Path

from shared_store.wording import nearest
from worker.racer.rewards.problems import Problem, RewardRefused
from worker.racer.rewards.samples import samples

LARGEST = 140_000
"""Characters of a file."""
MODULES = ("math", "random", "numpy", "scipy", "shapely")
"""Packages that may be imported."""
SECONDS = 5.0
"""For a call on one sample, and for the file's own statements with their imports [s]."""
_PATIENCE = 60.0
"""For the whole process, which a loaded machine may start late [s]."""
NAMES = frozenset(
    (  # noqa: SIM905
        "open exec eval compile input breakpoint exit quit help globals locals vars dir getattr setattr delattr"
    ).split()
)
"""Built-in functions that may not be named."""
_SYSTEM = frozenset("os sys subprocess builtins importlib ctypes socket shutil pathlib pickle io posix".split())  # noqa: SIM905
_FILES = frozenset(
    (  # noqa: SIM905
        "load save savez savez_compressed savetxt loadtxt fromfile tofile genfromtxt fromregex memmap "
        "open_memmap DataSource dump dumps ctypeslib f2py distutils testing lib datasets system popen"
    ).split()
)
"""Attributes of modules, and methods of arrays, that read or write files or start programs."""
_SUBMODULES = {
    "scipy.io",
    "scipy.datasets",
    "scipy.weave",
    "numpy.ctypeslib",
    "numpy.f2py",
    "numpy.lib",
    "numpy.testing",
}
_OWN = {"self", "cls"}


def check(path: Path) -> Problem | None:
    """The first fault of a reward function in a file, or None.

    Args:
        path: The file.
    """
    try:
        return check_source(read_file(path), str(path))
    except RewardRefused as refused:
        return refused.problem


def read_file(path: Path) -> str:
    """The text of a file.

    Raises:
        RewardRefused: It can't be read, or is no text.
    """
    try:
        with open(path, "rb") as opened:
            data = opened.read(4 * LARGEST + 4)
    except OSError as error:
        told = f"the file can't be read: {error.strerror}"
        raise RewardRefused(Problem("TEST_FAILURE", told, str(path))) from error
    try:
        encoding, _ = tokenize.detect_encoding(io.BytesIO(data).readline)
        return io.TextIOWrapper(io.BytesIO(data), encoding).read()
    except (SyntaxError, UnicodeDecodeError, LookupError) as error:
        told = f"the file is no text: {str(error).splitlines()[0]}"
        raise RewardRefused(Problem("SYNTAX_ERROR", told, str(path))) from error


def check_source(source: str, file: str = "reward_function.py") -> Problem | None:
    """:func:`check`, of a text.

    Args:
        source: The text.
        file: The name of its file, for messages.
    """
    return read(source, file) or try_out(source, file)


def read(source: str, file: str) -> Problem | None:
    """Faults of the text itself, which is not run."""
    if len(source) > LARGEST:
        return Problem("SYNTAX_ERROR", f"{len(source):,} characters; a reward function has at most {LARGEST:,}", file)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            tree = ast.parse(source, file)
    except SyntaxError as error:
        return Problem("SYNTAX_ERROR", error.msg, file, error.lineno or 0)
    except (ValueError, RecursionError, MemoryError) as error:
        told = str(error) if isinstance(error, ValueError) else "it is nested too deeply"
        return Problem("SYNTAX_ERROR", told, file)
    return next((Problem(kind, told, file, line) for kind, told, line in _findings(tree)), None)


def _findings(tree: ast.Module) -> Iterator[tuple[str, str, int]]:
    """Kind, message and line of all that is wrong, imports and names before the function itself."""
    nodes = sorted(ast.walk(tree), key=lambda node: getattr(node, "lineno", 0))
    imported: dict[str, str] = {}
    for node in nodes:
        if isinstance(node, ast.Import):
            imported |= {alias.asname or alias.name.partition(".")[0]: alias.name for alias in node.names}
        yield from _import(node)
    for node in nodes:
        if isinstance(node, ast.Name):
            yield from _name(node)
        elif isinstance(node, ast.Attribute):
            yield from _attribute(node, imported)
    yield from _function(tree)


def _import(node: ast.AST) -> Iterator[tuple[str, str, int]]:
    if isinstance(node, ast.Import):
        names = [alias.name for alias in node.names]
    elif isinstance(node, ast.ImportFrom):
        if node.level:
            yield "IMPORT_ERROR", "a reward function is one file: it can't import from beside it", node.lineno
            return
        names = [node.module or ""]
        if names[0] == "__future__":
            return
    else:
        return
    for name in names:
        if name.partition(".")[0] not in MODULES:
            yield (
                "IMPORT_ERROR",
                f"{name} can't be imported; a reward function may import {', '.join(MODULES)}",
                node.lineno,
            )
        elif any(name == each or name.startswith(f"{each}.") for each in _SUBMODULES) or "._" in name:
            yield "FORBIDDEN", f"{name} can't be used in a reward function", node.lineno
        for alias in node.names if isinstance(node, ast.ImportFrom) else ():
            if alias.name in _FILES | _SYSTEM or alias.name.startswith("_"):
                yield "FORBIDDEN", f"{name}.{alias.name} can't be used in a reward function", node.lineno
            if alias.name == "*":
                yield "IMPORT_ERROR", f"from {name} import *: name what you use", node.lineno


def _name(node: ast.Name) -> Iterator[tuple[str, str, int]]:
    if node.id in NAMES or (node.id.startswith("__") and node.id != "__name__"):
        yield "FORBIDDEN", f"{node.id} can't be used in a reward function", node.lineno


def _attribute(node: ast.Attribute, imported: dict[str, str]) -> Iterator[tuple[str, str, int]]:
    name, base = node.attr, node.value
    while isinstance(base, ast.Attribute):
        base = base.value
    of_module = isinstance(base, ast.Name) and base.id in imported
    own = isinstance(node.value, ast.Name) and node.value.id in _OWN
    dunder = name.startswith("__") and name != "__init__"
    hidden = name.startswith("_") and not name.startswith("__") and not own
    if dunder or hidden or name in _SYSTEM or name == "tofile" or (of_module and name in _FILES):
        yield "FORBIDDEN", f"the attribute {name} can't be used in a reward function", node.lineno


def _function(tree: ast.Module) -> Iterator[tuple[str, str, int]]:
    found = [node for node in tree.body if isinstance(node, ast.FunctionDef) and node.name == "reward_function"]
    if not found:
        other = [node.name for node in tree.body if isinstance(node, ast.FunctionDef)]
        near = (
            nearest("reward_function", other, "define it at the top level of the file")
            if other
            else "the file defines none"
        )
        yield "TEST_FAILURE", f"there is no def reward_function(params); {near}", 0
        return
    if len(found) > 1:
        yield (
            "TEST_FAILURE",
            f"reward_function is defined {len(found)} times; the first is in line {found[0].lineno}",
            found[1].lineno,
        )
    arguments = found[0].args
    given = [*arguments.posonlyargs, *arguments.args]
    if len(given) != 1 or arguments.vararg or arguments.kwarg or arguments.kwonlyargs:
        yield "TEST_FAILURE", "reward_function takes one argument: def reward_function(params)", found[0].lineno


def try_out(source: str, file: str) -> Problem | None:
    """Faults with sample inputs, found in a process of its own with limits."""
    root = str(Path(__file__).parents[3])
    asked = {"source": source, "file": file, "samples": samples(), "seconds": SECONDS, "root": root}
    command = [sys.executable, "-I", "-B", str(Path(__file__).with_name("trial.py"))]
    try:
        ended = subprocess.run(
            command, input=json.dumps(asked), capture_output=True, text=True, timeout=_PATIENCE, env=environment()
        )
    except subprocess.TimeoutExpired as error:
        said = error.stdout.decode() if isinstance(error.stdout, bytes) else error.stdout or ""
        return Problem("TIMEOUT", f"{_last(said)} did not end within {_PATIENCE:g} s", file)
    lines = [json.loads(line) for line in ended.stdout.splitlines() if line.startswith("{")]
    if lines and "kind" in lines[-1]:
        found = lines[-1]
        return Problem(found["kind"], found["message"], file, found["line"]) if found["kind"] else None
    if not lines:
        told = " ".join(ended.stderr.split())[-300:]
        return Problem("TEST_FAILURE", f"the process that tries the function did not start: {told}", file)
    cause = f"signal {-ended.returncode}" if ended.returncode < 0 else f"exit code {ended.returncode}"
    return Problem("TEST_FAILURE", f"{_last(ended.stdout)} ended the process ({cause})", file)


def _last(said: str) -> str:
    """The last step that the process reported."""
    lines = [json.loads(line) for line in said.splitlines() if line.startswith('{"trying"') and line.endswith("}")]
    return str(lines[-1]["trying"]) if lines else "the file"


def environment() -> dict[str, str]:
    """Variables of a process that runs a learner's function: no secret, and one thread for NumPy's libraries."""
    kept = {name: os.environ[name] for name in ("PATH", "LD_LIBRARY_PATH", "LANG", "TZ") if name in os.environ}
    threads = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
    return {**kept, **dict.fromkeys(threads, "1")}
