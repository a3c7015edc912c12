"""The guard of reward functions, before any job starts: it checks the text, imports and names, and the behaviour on sample inputs.

The text's check is against mistakes and carelessness: a determined attacker gets round it. What holds such a one, while the samples
are tried, is the process's sandbox (:mod:`~racer.rewards.sandbox`).
"""

from __future__ import annotations

import ast
import contextlib
import dataclasses
import dis
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
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from types import CodeType
from typing import Any

from racer.rewards.namespaces import FILES, MODULES, NAMES, SUBMODULES
from racer.rewards.problems import KINDS, Problem, RewardRefused, plain
from racer.rewards.samples import OVAL, Course
from shared_store.contract.error_text import nearest

LARGEST = 140_000
"""Characters of a file."""
MOST_TOKENS = 60_000
"""Words, signs and lines of a file: what its parser takes time and memory for. The longest of 299 real files has 45,000."""
SECONDS = 5.0
"""For a call on one sample; the file's own statements, with their imports, have four times as long [s]."""
_LOOKS_UP = ("LOAD_NAME", "LOAD_GLOBAL", "LOAD_FROM_DICT_OR_GLOBALS")
"""Instructions that look a name up among the built-in functions, too."""
_MOST_COUNTED = 100_000_000
"""Characters of a file that is too long; then the count ends."""
_PATIENCE = 60.0
"""For the whole process, which a loaded machine may start late [s]."""
_MOST_OUTPUT = 64 << 10
"""Bytes that the process may answer."""
_LONGEST = 400
"""Characters of a message."""
Note = Callable[[str], object]
"""Is called with a line for the user."""
_SYSTEM = frozenset("os sys subprocess builtins importlib ctypes socket shutil pathlib pickle io posix".split())  # noqa: SIM905

_MACHINERY = frozenset("__builtins__ __modules__ __import__ __build_class__ __loader__ __spec__".split())  # noqa: SIM905
"""Names that Python or Muster defines in a function's namespace."""
_HARMLESS = frozenset(
    (  # noqa: SIM905
        "__init__ __post_init__ __name__ __doc__ __version__ __call__ __len__ __contains__ __getitem__ __setitem__ __iter__ __next__ "
        "__str__ __repr__"
    ).split()
)
"""Special attributes that lead to nothing outside the file."""


def check(path: Path, courses: Sequence[Course] = (OVAL,), note: Note | None = None) -> Problem | None:
    """The first fault of a reward function in a file, or None.

    Args:
        path: The file.
        courses: As of :func:`check_source`.
        note: As of :func:`check_source`.
    """
    try:
        return check_source(read_file(path), str(path), courses, note=note)
    except RewardRefused as refused:
        return refused.problem


def read_file(path: Path) -> str:
    """The text of a file.

    Raises:
        RewardRefused: It can't be read, or is not text.
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
        message = f"the file can't be read: {error.strerror}"
        raise RewardRefused(Problem("TEST_FAILURE", message, str(path))) from error
    except (SyntaxError, UnicodeDecodeError, LookupError) as error:
        message = f"the file is not text: {str(error).splitlines()[0]}"
        raise RewardRefused(Problem("SYNTAX_ERROR", message, str(path))) from error
    raise RewardRefused(_too_long(count, str(path)))


def check_source(
    source: str,
    file: str = "reward_function.py",
    courses: Sequence[Course] = (OVAL,),
    *,
    anyway: bool = False,
    note: Note | None = None,
) -> Problem | None:
    """:func:`check`, of a text.

    Args:
        source: The text.
        file: The name of its file, for messages.
        courses: The job's tracks with their objects, on which it is tried.
        anyway: Run it also where the sandbox does not hold: for a job's own node, which runs the function in any case.
        note: Called with one line where the sandbox does not hold, and for a function that passes with objects alone, on a track without.
    """
    if problem := read(source, file):
        return problem
    notes: list[str] = []
    found = (_fault_on(course, source, file, anyway, notes) for course in courses)
    problem = next((each for each in found if each is not None), None)
    if note is not None:
        for line in dict.fromkeys(notes):
            note(line)
    return problem


def _fault_on(course: Course, source: str, file: str, anyway: bool, notes: list[str]) -> Problem | None:
    """The fault that a function has on a track; None where it passes one of the track's trials."""
    first, *others = course.trials()
    fault = try_out(source, file, first, anyway=anyway, note=notes.append)
    if fault is not None and fault.message.startswith("the sample "):
        fault = dataclasses.replace(fault, message=f"{fault.message}{course.where}")
    if fault is None or fault.kind != "TEST_FAILURE":
        return fault
    for other in others:
        if try_out(source, file, other, anyway=anyway, note=notes.append) is None:
            place = f"{file}:{fault.line}" if fault.line else file
            failing = (
                f"it fails where there are no objects{', as in this job' if course.name else ''} ({fault.message})"
            )
            notes.append(
                f"{place}: {failing}; it is valid, since it passes with objects, with which AWS tries it: add obstacles"
            )
            return None
    return fault


@functools.lru_cache(maxsize=16)
def read(source: str, file: str) -> Problem | None:
    """Faults of the text itself, which is not run."""
    if len(source) > LARGEST:
        return _too_long(len(source), file)
    if (tokens := len(re.findall(r"\w+|[^\w \t]", source))) > MOST_TOKENS:
        message = f"{tokens:,} words, signs and lines; a reward function has at most {MOST_TOKENS:,}"
        return Problem("SYNTAX_ERROR", message, file)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            tree = ast.parse(source, file)
            code = compile(tree, file, "exec", dont_inherit=True)
    except SyntaxError as error:
        return Problem("SYNTAX_ERROR", error.msg, file, error.lineno or 0)
    except (ValueError, RecursionError, MemoryError) as error:
        message = str(error) if isinstance(error, ValueError) else "it is nested too deeply"
        return Problem("SYNTAX_ERROR", message, file)
    return next((Problem(kind, message, file, line) for kind, message, line in _findings(tree, code)), None)


def _too_long(count: int, file: str) -> Problem:
    message = f"{count:,}" if count <= _MOST_COUNTED else f"more than {_MOST_COUNTED:,}"
    return Problem("SYNTAX_ERROR", f"{message} characters; a reward function has at most {LARGEST:,}", file)


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
    used += [(node.id, node.lineno) for node in nodes if isinstance(node, ast.Name) and node.id in _MACHINERY]
    for name, line in sorted(used, key=lambda item: item[1]):
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
    # a private one of a class of the file itself, such as self.__best, reaches nothing else
    special = (name[:2] == "__" == name[-2:] or (of_module and name[:1] == "_")) and name not in _HARMLESS
    if special or name == "tofile" or (of_module and name in FILES | _SYSTEM):
        yield "FORBIDDEN", f"the attribute {name} can't be used in a reward function", node.lineno


def _function(tree: ast.Module, code: CodeType) -> Iterator[tuple[str, str, int]]:
    found = [node for node in tree.body if isinstance(node, ast.FunctionDef) and node.name == "reward_function"]
    for node in found[-1:]:  # which Python takes
        if not _takes_one(node.args) and not node.decorator_list:
            yield "TEST_FAILURE", "reward_function takes one argument: def reward_function(params)", node.lineno
    if "reward_function" not in _bound(code):
        near = "the file defines none"
        if other := [node.name for node in tree.body if isinstance(node, ast.FunctionDef)]:
            near = nearest("reward_function", other, "define it at the top level of the file", cutoff=0.5)
        yield "TEST_FAILURE", f"there is no def reward_function(params); {near}", 0


def _takes_one(arguments: ast.arguments) -> bool:
    """Whether a function can be called with one argument."""
    names = len(arguments.posonlyargs) + len(arguments.args)
    needed = names - len(arguments.defaults)
    return needed <= 1 and (names > 0 or arguments.vararg is not None) and None not in arguments.kw_defaults


def try_out(
    source: str,
    file: str,
    samples: Mapping[str, Any],
    *,
    anyway: bool = False,
    note: Note | None = None,
) -> Problem | None:
    """Faults with sample inputs, found in a separate process with limits. Other arguments as of :func:`check_source`.

    Args:
        source: The text.
        file: The name of its file.
        samples: By name.
        anyway: Run it without a sandbox.
        note: Called with one line.

    The process may be in the hands of an attacker: its answer is bounded, and can say nothing but a fault of this function.
    """
    root = str(Path(__file__).parents[2])
    request = {"source": source, "file": file, "samples": samples, "seconds": SECONDS, "root": root, "anyway": anyway}
    answer, errors, code = _answer(json.dumps(request).encode())
    lines = [line for each in answer.decode(errors="replace").splitlines() if (line := _read_line(each))]
    unconfined = next((plain(str(line["unconfined"])) for line in lines[:1] if "unconfined" in line), "")
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
        message = plain(errors.decode(errors="replace")[-300:], _LONGEST)
        return Problem("TEST_FAILURE", f"the process that tries the function did not start: {message}", file)
    found = lines[-1]
    if found.get("kind") == "":
        return None
    if found.get("kind") in KINDS and isinstance(found.get("line"), int):
        return Problem(found["kind"], plain(str(found.get("message")), _LONGEST), file, found["line"])
    cause = f"signal {-code}" if code < 0 else f"exit code {code}"
    return Problem("TEST_FAILURE", f"{_last(lines)} ended the process ({cause})", file)


def _answer(request: bytes) -> tuple[bytes, bytes, int | None]:
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
                process.stdin.write(request)
            answer = process.stdout.read(_MOST_OUTPUT)
            if len(answer) == _MOST_OUTPUT:
                process.kill()
            errors = process.stderr.read(_MOST_OUTPUT)
            code = process.wait()
        finally:
            timer.cancel()
            process.kill()
    return answer, errors, None if late.is_set() else code


def _read_line(line: str) -> dict[str, Any]:
    """A line of the answer; nothing where it is none."""
    try:
        answer = json.loads(line)
    except (ValueError, RecursionError):
        return {}
    return answer if isinstance(answer, dict) else {}


def _last(lines: list[dict[str, Any]]) -> str:
    """The last step that the process reported."""
    return next((plain(str(line["trying"])) for line in reversed(lines) if "trying" in line), "the file")


def environment() -> dict[str, str]:
    """Variables of a process that runs a learner's function: no secret, and one thread for NumPy's libraries."""
    kept = {name: os.environ[name] for name in ("PATH", "LD_LIBRARY_PATH", "LANG", "TZ") if name in os.environ}
    threads = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
    return {**kept, **dict.fromkeys(threads, "1")}
