"""Mistakes in the code of a user's task, reported in one line with the file; a retry would not help."""

from __future__ import annotations

import builtins
import re
import sys
import sysconfig
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import CodeType, FrameType, TracebackType

from shared_store.contract.error_text import nearest
from worker.settings.errors import UserError, is_out_of_memory

_OURS = str(Path(__file__).parents[2])
_INSTALLED = tuple({sysconfig.get_path(kind) for kind in ("purelib", "platlib", "stdlib", "platstdlib")})
_PARSED = re.compile(r'Error while parsing function "[^"]*" at (?P<file>[^\n]+):(?P<line>\d+):\n')
"""Warp's message about a function that can't be compiled, once for each function in the call chain."""
_OUTER = re.compile(r"Invalid external reference type: <class '[^']*?(\w+)'>")
"""Warp's message about a variable outside the function."""
_INSIDE = re.compile(r" \(<[^>]*\bwarp\._src\.[^>]*>\)")
"""An object of Warp's in its message."""
_STRUCT = "NewStructInstance"
"""Warp's class of all structs."""
_MISSING_FILES = (FileNotFoundError, IsADirectoryError, NotADirectoryError, PermissionError)


class TaskMistake(ValueError):
    """An error in the user's own code.

    Args:
        words: One line: task, file and line, error.
        trace: The traceback, if the error arose deep in a library; else empty.
    """

    def __init__(self, words: str, trace: str = "") -> None:
        super().__init__(words)
        self.trace = trace


@contextmanager
def task_mistakes(task: str) -> Iterator[None]:
    """Turn an exception that passed through the user's own code into a :class:`TaskMistake`; let all others pass.

    Args:
        task: Name of the task, or ``module:Class``.
    """
    try:
        yield
    except (UserError, TaskMistake):
        raise
    except Exception as error:
        mistake = _mistake(error, task)
        if mistake is None:
            raise
        raise mistake from error


def _mistake(error: Exception, task: str) -> TaskMistake | None:
    package = task.partition(":")[0].partition(".")[0]
    # a store or a device that fails now may work at the next attempt
    if is_out_of_memory(error) or (isinstance(error, OSError) and not isinstance(error, _MISSING_FILES)):
        return None
    text = error.args[0] if error.args and isinstance(error.args[0], str) else str(error)
    if struct := getattr(getattr(error, "obj", None), "cls", None):
        text = text.replace(_STRUCT, struct.__name__)
    if (parsed := _parsed(text, package)) is not None:
        where, words = parsed
        return TaskMistake(f"task {task}: {where}: {words}")
    if isinstance(error, SyntaxError) and error.filename and _is_users(error.filename, package):
        return TaskMistake(f"task {task}: {_shown(error.filename)}:{error.lineno}: {type(error).__name__}: {error.msg}")
    steps = [*_steps(error.__traceback__)]
    users = [(frame, line) for frame, line in steps if _is_users(frame.f_code.co_filename, package)]
    if not users:
        return None
    frame, line = users[-1]
    kind = "" if type(error) is ValueError else f"{type(error).__name__}: "
    if type(error) is KeyError:
        text = repr(error.args[0]) if error.args else ""
    words = "; ".join(filter(None, (" ".join(text.split()) or "no message", _hint(error, frame))))
    is_deep = steps[-1][0] is not frame and not isinstance(error, ValueError | AttributeError | ImportError)
    trace = "".join(traceback.format_exception(error)) if is_deep else ""
    return TaskMistake(f"task {task}: {_shown(frame.f_code.co_filename)}:{line}: {kind}{words}", trace)


def _steps(step: TracebackType | None) -> Iterator[tuple[FrameType, int]]:
    while step is not None:
        yield step.tb_frame, step.tb_lineno
        step = step.tb_next


def _is_users(file: str, package: str) -> bool:
    """Whether a file is the user's: neither Muster's nor of an installed library, unless the task itself is installed."""
    if file.startswith("<") or Path(file).is_relative_to(_OURS):
        return False
    root = next((root for root in _INSTALLED if Path(file).is_relative_to(root)), None)
    return root is None or Path(file).relative_to(root).parts[0].removesuffix(".py") == package


def _parsed(text: str, package: str) -> tuple[str, str] | None:
    """The place of a user's function that Warp could not compile, and Warp's message."""
    users = [found for found in _PARSED.finditer(text) if _is_users(found["file"], package)]
    if not users:
        return None
    source, _, message = text[users[-1].end() :].partition("\n;")
    message = _INSIDE.sub("", " ".join((message or source).removeprefix("Error, ").split()))
    if outer := _OUTER.search(message):
        kind = "Warp struct" if outer[1] == _STRUCT else outer[1]
        message = f"a Warp function can't use a {kind} from outside; make it a parameter, or use a number"
    return (
        f"{_shown(users[-1]['file'])}:{users[-1]['line']}",
        f"{message} (in `{source.strip()}`)" if source else message,
    )


def _hint(error: Exception, frame: FrameType) -> str:
    """The nearest existing name."""
    name, known = getattr(error, "name", None), []
    if isinstance(error, AttributeError) and getattr(error, "obj", None) is not None:
        known = dir(error.obj)
    elif isinstance(error, NameError):
        known = [*_names(frame.f_code), *frame.f_globals, *dir(builtins)]
    elif isinstance(error, ImportError) and (found := re.match(r"cannot import name '(\w+)'", str(error))):
        known, name = dir(sys.modules.get(str(error.name))), found[1]
    near = nearest(name, known, " ") if name and known else ""
    return near.strip()


def _names(code: CodeType) -> tuple[str, ...]:
    return code.co_varnames + code.co_freevars


def _shown(file: str) -> str:
    """A file's path relative to the job's directory."""
    path = Path(file)
    return str(path.relative_to(Path.cwd())) if path.is_relative_to(Path.cwd()) else file
