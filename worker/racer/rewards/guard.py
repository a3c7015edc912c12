"""Checks a reward function before any job starts: its text, its imports and names, and what it does with sample inputs.

The text's check is against mistakes and carelessness: a determined attacker gets round it. What holds such a one, while the samples
are tried, is the process's sandbox (:mod:`~worker.racer.rewards.sandbox`).
"""

from __future__ import annotations

import ast
import contextlib
import functools
import io
import json
import os
import re
import subprocess
import sys
import threading
import tokenize
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from shared_store.wording import nearest
from worker.racer.rewards.problems import KINDS, Problem, RewardRefused
from worker.racer.rewards.samples import samples

LARGEST = 140_000
"""Characters of a file."""
MOST_TOKENS = 60_000
"""Words, signs and lines of a file: what its parser takes time and memory for. The longest of 299 real files has 45,000."""
MODULES = ("math", "random", "numpy", "scipy", "shapely")
"""Packages that may be imported."""
SECONDS = 5.0
"""For a call on one sample, and for the file's own statements with their imports [s]."""
_PATIENCE = 60.0
"""For the whole process, which a loaded machine may start late [s]."""
_MOST_SAID = 64 << 10
"""Bytes that the process may answer."""
Note = Callable[[str], object]
"""Is called with a line for the user."""
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


def check(path: Path, note: Note | None = None) -> Problem | None:
    """The first fault of a reward function in a file, or None.

    Args:
        path: The file.
        note: As of :func:`check_source`.
    """
    try:
        return check_source(read_file(path), str(path), note=note)
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


def check_source(
    source: str, file: str = "reward_function.py", *, anyway: bool = False, note: Note | None = None
) -> Problem | None:
    """:func:`check`, of a text.

    Args:
        source: The text.
        file: The name of its file, for messages.
        anyway: Run it also where the sandbox does not hold: for a job's own node, which runs the function in any case.
        note: Called with one line where the sandbox does not hold.
    """
    return read(source, file) or try_out(source, file, anyway=anyway, note=note)


@functools.lru_cache(maxsize=16)
def read(source: str, file: str) -> Problem | None:
    """Faults of the text itself, which is not run."""
    if len(source) > LARGEST:
        return Problem("SYNTAX_ERROR", f"{len(source):,} characters; a reward function has at most {LARGEST:,}", file)
    if (tokens := len(re.findall(r"\w+|[^\w \t]", source))) > MOST_TOKENS:
        told = f"{tokens:,} words, signs and lines; a reward function has at most {MOST_TOKENS:,}"
        return Problem("SYNTAX_ERROR", told, file)
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


def try_out(source: str, file: str, *, anyway: bool = False, note: Note | None = None) -> Problem | None:
    """Faults with sample inputs, found in a process of its own with limits. Arguments as of :func:`check_source`.

    The process may be in the hands of an attacker: its answer is bounded, and can say nothing but a fault of this function.
    """
    root = str(Path(__file__).parents[3])
    asked = {
        "source": source,
        "file": file,
        "samples": samples(),
        "seconds": SECONDS,
        "root": root,
        "anyway": anyway,
    }
    answer, errors, code = _answer(json.dumps(asked).encode())
    lines = [line for each in answer.decode(errors="replace").splitlines() if (line := _read_line(each))]
    unconfined = next((str(line["unconfined"]) for line in lines[:1] if "unconfined" in line), "")
    if unconfined and note is not None:
        fate = (
            "the function is not kept from this job's files" if anyway else "it was not run: the job's own nodes try it"
        )
        note(f"{file}: no sandbox, since {unconfined}; {fate}")
    if unconfined and not anyway:
        return None
    if code is None:
        return Problem("TIMEOUT", f"{_last(lines)} did not end within {_PATIENCE:g} s", file)
    if not lines:
        told = " ".join(errors.decode(errors="replace").split())[-300:]
        return Problem("TEST_FAILURE", f"the process that tries the function did not start: {told}", file)
    found = lines[-1]
    if found.get("kind") == "":
        return None
    if found.get("kind") in KINDS and isinstance(found.get("line"), int):
        return Problem(found["kind"], " ".join(str(found.get("message")).split()), file, found["line"])
    cause = f"signal {-code}" if code < 0 else f"exit code {code}"
    return Problem("TEST_FAILURE", f"{_last(lines)} ended the process ({cause})", file)


def _answer(asked: bytes) -> tuple[bytes, bytes, int | None]:
    """What the process wrote, its errors, and its exit code; None: it did not end in time."""
    late = threading.Event()

    def expire() -> None:
        late.set()
        process.kill()

    with subprocess.Popen(
        [sys.executable, "-I", "-B", str(Path(__file__).with_name("trial.py"))],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env=environment(),
    ) as process:
        assert process.stdin is not None and process.stdout is not None and process.stderr is not None
        timer = threading.Timer(_PATIENCE, expire)
        timer.start()
        try:
            with contextlib.suppress(BrokenPipeError), process.stdin:
                process.stdin.write(asked)
            said = process.stdout.read(_MOST_SAID)
            if len(said) == _MOST_SAID:
                process.kill()
            errors = process.stderr.read(_MOST_SAID)
            code = process.wait()
        finally:
            timer.cancel()
            process.kill()
    return said, errors, None if late.is_set() else code


def _read_line(line: str) -> dict[str, Any]:
    """A line of the answer; nothing where it is none."""
    try:
        said = json.loads(line)
    except (ValueError, RecursionError):
        return {}
    return said if isinstance(said, dict) else {}


def _last(lines: list[dict[str, Any]]) -> str:
    """The last step that the process reported."""
    return next((str(line["trying"]) for line in reversed(lines) if "trying" in line), "the file")


def environment() -> dict[str, str]:
    """Variables of a process that runs a learner's function: no secret, and one thread for NumPy's libraries."""
    kept = {name: os.environ[name] for name in ("PATH", "LD_LIBRARY_PATH", "LANG", "TZ") if name in os.environ}
    threads = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
    return {**kept, **dict.fromkeys(threads, "1")}
