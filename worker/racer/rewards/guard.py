"""Checks a reward function before any job starts: its text, its imports and names, and what it does with sample inputs.

It is a guard against mistakes and carelessness, not a sandbox: a determined attacker gets round it. What isolates jobs is in
docs/security.md.
"""

from __future__ import annotations

import ast
import dis
import io
import json
import os
import subprocess
import sys
import tokenize
import warnings
from collections.abc import Iterator
from pathlib import Path
from types import CodeType

from shared_store.wording import nearest
from worker.racer.rewards.namespaces import FILES, MODULES, NAMES, SUBMODULES
from worker.racer.rewards.problems import Problem, RewardRefused
from worker.racer.rewards.samples import samples

LARGEST = 140_000
"""Characters of a file."""
SECONDS = 5.0
"""For a call on one sample; the file's own statements, with their imports, have four times as long [s]."""
_LOOKS_UP = ("LOAD_NAME", "LOAD_GLOBAL", "LOAD_FROM_DICT_OR_GLOBALS")
"""Instructions that look a name up among the built-in functions, too."""
_MOST_COUNTED = 100_000_000
"""Characters of a file that is too long; then the count ends."""
_PATIENCE = 60.0
"""For the whole process, which a loaded machine may start late [s]."""
_SYSTEM = frozenset("os sys subprocess builtins importlib ctypes socket shutil pathlib pickle io posix".split())  # noqa: SIM905
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
        with io.BufferedReader(io.FileIO(path), 1 << 20) as opened:
            encoding, _ = tokenize.detect_encoding(io.BytesIO(opened.peek()).readline)
            lines = io.TextIOWrapper(opened, encoding)
            text = lines.read(LARGEST + 1)
            if len(text) <= LARGEST:
                return text
            count = len(text)
            while count <= _MOST_COUNTED and (part := lines.read(1 << 20)):
                count += len(part)
    except OSError as error:
        told = f"the file can't be read: {error.strerror}"
        raise RewardRefused(Problem("TEST_FAILURE", told, str(path))) from error
    except (SyntaxError, UnicodeDecodeError, LookupError) as error:
        told = f"the file is no text: {str(error).splitlines()[0]}"
        raise RewardRefused(Problem("SYNTAX_ERROR", told, str(path))) from error
    raise RewardRefused(_too_long(count, str(path)))


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
        return _too_long(len(source), file)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            tree = ast.parse(source, file)
            code = compile(tree, file, "exec", dont_inherit=True)
    except SyntaxError as error:
        return Problem("SYNTAX_ERROR", error.msg, file, error.lineno or 0)
    except (ValueError, RecursionError, MemoryError) as error:
        told = str(error) if isinstance(error, ValueError) else "it is nested too deeply"
        return Problem("SYNTAX_ERROR", told, file)
    return next((Problem(kind, told, file, line) for kind, told, line in _findings(tree, code)), None)


def _too_long(count: int, file: str) -> Problem:
    told = f"{count:,}" if count <= _MOST_COUNTED else f"more than {_MOST_COUNTED:,}"
    return Problem("SYNTAX_ERROR", f"{told} characters; a reward function has at most {LARGEST:,}", file)


def _findings(tree: ast.Module, code: CodeType) -> Iterator[tuple[str, str, int]]:
    """Kind, message and line of all that is wrong, imports and names before the function itself."""
    nodes = sorted(ast.walk(tree), key=lambda node: getattr(node, "lineno", 0))
    imported: dict[str, str] = {}
    for node in nodes:
        if isinstance(node, ast.Import):
            imported |= {alias.asname or alias.name.partition(".")[0]: alias.name for alias in node.names}
        yield from _import(node)
    starred = any(isinstance(node, ast.ImportFrom) and node.names[0].name == "*" for node in nodes)
    used = [*_unbound(code, NAMES | FILES if starred else NAMES, _bound(code))]
    used += [(node.id, node.lineno) for node in nodes if isinstance(node, ast.Name) and node.id[:2] == "__"]
    for name, line in sorted(used, key=lambda item: item[1]):
        if name != "__name__":
            yield "FORBIDDEN", f"{name} can't be used in a reward function", line
    for node in nodes:
        if isinstance(node, ast.Attribute):
            yield from _attribute(node, imported)
    yield from _function(tree, code)


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
        elif any(name == each or name.startswith(f"{each}.") for each in SUBMODULES) or "._" in name:
            yield "FORBIDDEN", f"{name} can't be used in a reward function", node.lineno
        for alias in node.names if isinstance(node, ast.ImportFrom) else ():
            if alias.name in FILES | _SYSTEM or alias.name.startswith("_"):
                yield "FORBIDDEN", f"{name}.{alias.name} can't be used in a reward function", node.lineno


def _bound(code: CodeType, stores: tuple[str, ...] = ("STORE_NAME", "STORE_GLOBAL")) -> set[str]:
    """The global names to which a file gives values, also in its functions."""
    found = {each.argval for each in dis.get_instructions(code) if each.opname in stores}
    return found.union(*(_bound(part, ("STORE_GLOBAL",)) for part in _parts(code)))


def _unbound(code: CodeType, names: frozenset[str], bound: set[str]) -> Iterator[tuple[str, int]]:
    """Uses of those of ``names`` that stand for built-in functions, with their lines: the compiler knows what is a variable."""
    instructions = list(dis.get_instructions(code))
    own = bound | {each.argval for each in instructions if each.opname == "STORE_NAME"}  # of a class
    for each in instructions:
        if each.opname in _LOOKS_UP and each.argval in names - own and each.positions:
            yield each.argval, each.positions.lineno or 0
    for part in _parts(code):
        yield from _unbound(part, names, bound)


def _parts(code: CodeType) -> list[CodeType]:
    """The functions and classes right inside some code."""
    return [each for each in code.co_consts if isinstance(each, CodeType)]


def _attribute(node: ast.Attribute, imported: dict[str, str]) -> Iterator[tuple[str, str, int]]:
    name, base = node.attr, node.value
    while isinstance(base, ast.Attribute):
        base = base.value
    of_module = isinstance(base, ast.Name) and base.id in imported
    own = isinstance(node.value, ast.Name) and node.value.id in _OWN
    dunder = name.startswith("__") and name != "__init__"
    hidden = name.startswith("_") and not name.startswith("__") and not own
    if dunder or hidden or name in _SYSTEM or name == "tofile" or (of_module and name in FILES):
        yield "FORBIDDEN", f"the attribute {name} can't be used in a reward function", node.lineno


def _function(tree: ast.Module, code: CodeType) -> Iterator[tuple[str, str, int]]:
    found = [node for node in tree.body if isinstance(node, ast.FunctionDef) and node.name == "reward_function"]
    if len(found) > 1:
        told = f"reward_function is defined {len(found)} times; the first is in line {found[0].lineno}"
        yield "TEST_FAILURE", told, found[1].lineno
    for node in found:
        if not _takes_one(node.args) and not node.decorator_list:
            yield "TEST_FAILURE", "reward_function takes one argument: def reward_function(params)", node.lineno
    if "reward_function" not in _bound(code):
        near = "the file defines none"
        if other := [node.name for node in tree.body if isinstance(node, ast.FunctionDef)]:
            near = nearest("reward_function", other, "define it at the top level of the file")
        yield "TEST_FAILURE", f"there is no def reward_function(params); {near}", 0


def _takes_one(arguments: ast.arguments) -> bool:
    """Whether a function can be called with one argument."""
    names = len(arguments.posonlyargs) + len(arguments.args)
    needed = names - len(arguments.defaults)
    return needed <= 1 and (names > 0 or arguments.vararg is not None) and None not in arguments.kw_defaults


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
