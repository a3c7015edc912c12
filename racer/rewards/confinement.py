"""The confined process that runs a learner's function: its limits, how the function is called, and the messages for its failures.

It imports nothing but the standard library: a process that runs a function starts in a few hundredths of a second.
"""

from __future__ import annotations

import contextlib
import ctypes
import math
import os
import resource
import signal
import sys
from collections.abc import Callable, Collection
from importlib.machinery import PathFinder
from typing import Any

from racer.rewards import sandbox
from racer.rewards.namespaces import Forbidden
from racer.rewards.problems import LARGEST_REWARD, one_line, out_of_range, plain

MEMORY = 2 << 30
"""Bytes of address space of a process that runs a reward function."""
MOST_PRINTED = 64 << 10
"""Characters that one call may print; what it prints is dropped."""
_PARENT_DEATH_SIGNAL = 1


def confine(memory: int = MEMORY, cpu: int | None = None, keep: Collection[int] = ()) -> str:
    """Limit this process for good: memory, CPU time, descriptors, and what its system calls reach (:mod:`~racer.rewards.sandbox`).

    Args:
        memory: Bytes of address space.
        cpu: Seconds of CPU time; None: no limit.
        keep: Descriptors that stay open, beside the first three.

    Returns:
        Why the sandbox does not hold here, one line; empty where it does.
    """
    libc = ctypes.CDLL(None, use_errno=True)
    for name in os.listdir("/proc/self/fd"):
        if (descriptor := int(name)) > 2 and descriptor not in keep:
            with contextlib.suppress(OSError):  # that of the list itself
                os.close(descriptor)
    limits = {resource.RLIMIT_AS: memory, resource.RLIMIT_FSIZE: 0, resource.RLIMIT_CORE: 0}
    if cpu is not None:
        limits[resource.RLIMIT_CPU] = cpu
    for kind, most in limits.items():
        sandbox.limit(kind, most)
    libc.prctl(_PARENT_DEATH_SIGNAL, signal.SIGKILL, 0, 0, 0)
    sys.meta_path.insert(0, _Hidden())
    return sandbox.enter(libc)


class _Hidden:
    """Packages that can't be read any more are not there: NumPy and SciPy use some of them where they find them."""

    @staticmethod
    def find_spec(name: str, path: object = None, target: object = None) -> None:
        """Raises ModuleNotFoundError for them."""
        known = path is not None or name in sandbox.PACKAGES or name in sys.stdlib_module_names
        if not known and PathFinder.find_spec(name, [os.path.dirname(os.__file__)]) is None:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)


class Printed:
    """Takes the place of standard output: counts what is printed, and drops it."""

    def __init__(self, flooded: Callable[[], None]) -> None:
        self.count = 0
        self._flooded = flooded

    def write(self, text: str) -> int:
        self.count += len(text)
        if self.count > MOST_PRINTED:
            self._flooded()
        return len(text)

    def flush(self) -> None:
        """Nothing to do."""


def line_of_frame(frame: Any, file: str) -> int:
    """The line of ``file`` that runs in a frame or above it; 0: none."""
    while frame is not None:
        if frame.f_code.co_filename == file:
            return int(frame.f_lineno)
        frame = frame.f_back
    return 0


def line_of(error: BaseException, file: str) -> int:
    """The line of ``file`` in which an exception was raised or that called what raised it; 0: none."""
    line, trace = 0, error.__traceback__
    while trace is not None:
        if trace.tb_frame.f_code.co_filename == file:
            line = trace.tb_lineno
        trace = trace.tb_next
    return line


def result_problem(result: Any) -> str:
    """The fault of a function's return value; empty without one.

    A truth value is refused: AWS's own check wants a float. Whole numbers and NumPy's numbers are taken as well.
    """
    if result is None:
        return "it returned None; return a number on every way through the function"
    name, kind = type(result).__name__, getattr(getattr(result, "dtype", None), "kind", "")
    if kind and getattr(result, "shape", ()) != ():
        return f"it returned an array of shape {result.shape}; return one number"
    if isinstance(result, bool) or kind == "b":
        return f"it returned {result}, a truth value; return a number such as float({result})"
    if not isinstance(result, int | float) and kind not in ("i", "u", "f"):
        what = f"an array of {result.dtype}" if name == "ndarray" else f"a {name}"
        return f"it returned {what}; return a number"
    try:
        value = float(result)
    except (TypeError, ValueError, OverflowError):
        return "it returned a number beyond the range of a float"
    if not math.isfinite(value):
        return f"it returned {value}; return a finite number"
    if abs(value) > LARGEST_REWARD:
        return out_of_range(value)
    return ""


def error_message(error: BaseException) -> str:
    """The message for an exception that a function raised."""
    if isinstance(error, Forbidden):
        return plain(str(error))
    if isinstance(error, ModuleNotFoundError):
        way = f": pip install {error.name} (the extra 'worker' has it)" if error.name in sandbox.PACKAGES else ""
        return plain(f"{error.name} is not installed here{way}")
    if isinstance(error, MemoryError):
        return f"it used more than {MEMORY >> 30} GiB of memory"
    if isinstance(error, RecursionError):
        return "it calls itself too often (RecursionError)"
    if isinstance(error, SystemExit):
        return "it ended the program (SystemExit)"
    return one_line(error)


class CallTimeout:
    """Ends a call that takes too long.

    Args:
        expired: Called with the frame that runs; it does not return as a rule.
    """

    def __init__(self, expired: Callable[[Any], None]) -> None:
        signal.signal(signal.SIGALRM, lambda _, frame: expired(frame))

    @staticmethod
    def set(seconds: float) -> None:
        """Start the clock; 0 stops it. A function that swallows the alarm gets it again every tenth of a second."""
        signal.setitimer(signal.ITIMER_REAL, seconds, 0.1 if seconds else 0.0)


@contextlib.contextmanager
def printing(printed: Printed) -> Any:
    """Redirects standard output to ``printed`` meanwhile."""
    kept = sys.stdout, sys.stderr
    sys.stdout = sys.stderr = printed
    try:
        yield
    finally:
        sys.stdout, sys.stderr = kept
