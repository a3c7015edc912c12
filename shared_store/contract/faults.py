"""Faults: the Python exceptions that would end the next attempt of a job as they ended this one, known by type, file, line and cause.

Memory, signals, hosts, volumes, networks, GPUs and collectives fail by chance or because something else did: their exceptions do not count as faults.
"""

from __future__ import annotations

import builtins
import os
import re
from dataclasses import dataclass
from pathlib import Path

from shared_store.contract.documents import parse

_LONGEST_NAME, _LONGEST_FILE, _LONGEST_CAUSE = 128, 512, 256
"""Characters that are kept: of a type's name and of a file's path the last ones, of a cause the first ones."""
_CHAINED = re.compile(
    r"^(?:During handling of the above exception, another exception occurred|"
    r"The above exception was the direct cause of the following exception):$",
    re.MULTILINE,
)
_START = "Traceback (most recent call last):"
_FRAME = re.compile(r'  File "(.+)", line ([0-9]{1,9})(?:, in .+)?')
_EXCEPTION = re.compile(r"([A-Za-z_][\w.]*)(?:: (.*))?")
_OUTSIDE_TYPES = (OSError, MemoryError, EOFError, KeyboardInterrupt, SystemExit)
_OUTSIDE_NAMES = re.compile(
    r"^(?:GangError|StaleEpoch|StoreError|DamagedCheckpoint|DamagedFile)$|"
    r"Memory|Connect|Timeout|TimedOut|Network|Socket|HTTP|SSL|URL|Unavailable|Retry|gaierror|Dist[A-Z]\w*Error|DistError|Accelerator|"
    r"Subprocess|CalledProcess|BrokenProcess|BrokenExecutor"
)
"""In names of types, without their modules, of what ends a rank from outside."""
_OUTSIDE_WORDS = re.compile(
    r"out of memory|failed to allocate|can't allocate memory|cannot allocate memory|CUDA (?:error|driver)|cuDNN|cuBLAS|NCCL|gloo|by peer|"
    r"connection (?:closed|reset|refused|aborted)|timed out|broken pipe|no space left|input/output error|stale file handle|"
    r"DataLoader worker",
    re.IGNORECASE,
)
_COLLECTIVES = "torch/distributed/"


@dataclass(frozen=True)
class Fault:
    """A Python exception that ended a rank, without its message."""

    type: str
    """Its class, with the module unless that is ``builtins``."""
    file: str
    """Path of the file that raised it, relative to the rank's directory if it lies there."""
    line: int
    cause: str = ""
    """Distinguishes exceptions that one line raises for unlike reasons, such as the reward term that is not finite. Without numbers
    that differ between attempts; empty as a rule."""

    def __post_init__(self) -> None:
        """Bounds the texts. Raises ValueError for a line that no file has."""
        if not 0 <= self.line < 2**31:
            raise ValueError("fault: line is out of range")
        object.__setattr__(self, "type", self.type[-_LONGEST_NAME:])
        object.__setattr__(self, "file", self.file[-_LONGEST_FILE:])
        object.__setattr__(self, "cause", self.cause[:_LONGEST_CAUSE])

    def __str__(self) -> str:
        return f"{self.type} in {self.file}, line {self.line}" + (f" ({self.cause})" if self.cause else "")


def fault_in(text: str, directory: Path | None = None, cause: str = "") -> Fault | None:
    """The fault in a traceback, as Python prints it; None for an exception that another attempt may not meet, or without a traceback.

    Args:
        text: Ends with the traceback. Exceptions that led to it, also printed, must be faults too.
        directory: The rank's working directory; None: that of this process.
        cause: :attr:`Fault.cause`, which no traceback shows.
    """
    try:
        above = f"{directory or os.getcwd()}/"
    except OSError:  # this process's directory is deleted
        above = "/"
    fault = None
    for part in reversed(_CHAINED.split(text)):
        if (found := _last(part)) is None:
            return None
        name, message, file, line = found
        if _is_from_outside(name, message, file):
            return None
        fault = fault or Fault(name, file.removeprefix(above), line, cause)
    return fault


def fault_from(value: object) -> Fault | None:
    """The fault of its ``asdict`` form, which a job can write itself; None for None. Raises ValueError if it is damaged."""
    fault: Fault | None = parse(Fault | None, value, "fault")
    return fault


def _last(text: str) -> tuple[str, str, str, int] | None:
    """Type, message, file and line of the last traceback in a text; the message's first line alone."""
    lines = text.rpartition(_START)[2].split("\n")[1:] if _START in text else []
    frame = None
    for line in lines:
        if not line.startswith(" "):
            found = _EXCEPTION.fullmatch(line)
            return (found[1], found[2] or "", frame[1], int(frame[2])) if found and frame else None
        frame = _FRAME.fullmatch(line) or frame
    return None


def _is_from_outside(name: str, message: str, file: str) -> bool:
    known = getattr(builtins, name, None)
    return (
        (isinstance(known, type) and issubclass(known, _OUTSIDE_TYPES))
        or _OUTSIDE_NAMES.search(name.rpartition(".")[2]) is not None
        or _OUTSIDE_WORDS.search(message) is not None
        or _COLLECTIVES in file
    )
