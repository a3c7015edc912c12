"""Processes of this machine, from ``/proc``: their descendants, their marks in the environment, and their reliable end.

Linux only. Imports only fast modules, because the node's shim uses it.
"""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import time
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass

PATIENCE = 10.0
"""Seconds after SIGKILL from which a process counts as unkillable."""
_LONGEST_PAUSE = 0.5
"""Seconds between two attempts to end the remaining processes."""
_STATES = {
    "D": "in an uninterruptible wait for a device, a file system or a frozen control group",
    "T": "stopped",
    "t": "traced by a debugger",
}


@dataclass(frozen=True)
class Process:
    """A running process, not a zombie; pid and start time identify it."""

    pid: int
    parent: int
    name: str
    state: str
    """One letter, as in ``proc(5)``."""
    start: str
    """Clock ticks since boot."""

    def __str__(self) -> str:
        doing = _STATES.get(self.state, "running or about to end")
        return f"process {self.pid} ({self.name}), state {self.state}: {doing}"


def find_process(pid: int) -> Process | None:
    """The process with that id; None if it is gone or a zombie.

    Raises OSError if it can't be read now, for example without free descriptors; that does not mean that the process has ended.
    """
    try:
        with open(f"/proc/{pid}/stat", errors="replace") as file:
            # field 2 is the name in brackets, which may hold spaces and brackets: split after the last one
            head, _, tail = file.read().rpartition(")")
    except (FileNotFoundError, ProcessLookupError):
        return None
    fields = tail.split()
    if not fields or fields[0] in "ZX":
        return None
    return Process(pid, int(fields[1]), head.partition("(")[2], fields[0], fields[19])


def descendants(of: int) -> list[Process]:
    """Children, grandchildren and so on of process ``of``, without itself."""
    children: dict[int, list[Process]] = {}
    for pid in _pids():
        if process := find_process(pid):
            children.setdefault(process.parent, []).append(process)
    found, following = [], [of]
    while following:
        below = children.pop(following.pop(), [])
        found += below
        following += [process.pid for process in below]
    return found


def children(of: int) -> list[int]:
    """Pids of the direct children of process ``of``, including zombies: fast, but not on every kernel, and without a guarantee."""
    try:
        with open(f"/proc/{of}/task/{of}/children") as file:
            return [int(pid) for pid in file.read().split()]
    except OSError:
        return []


def marked(marks: Collection[str]) -> list[Process]:
    """Processes, other than this one, that have all of ``marks`` (``NAME=VALUE``) in their environment.

    Raises ValueError without a mark, because all processes would match. Raises OSError as above.
    """
    expected = {mark.encode() for mark in marks}
    if not expected or any(not mark.partition(b"=")[2] for mark in expected):
        raise ValueError(f"no process can be identified by the marks {sorted(marks)}")
    found = []
    for pid in _pids():
        if pid == os.getpid():
            continue
        try:
            with open(f"/proc/{pid}/environ", "rb") as file:
                if not expected <= set(file.read().split(b"\0")):
                    continue
        except (FileNotFoundError, ProcessLookupError, PermissionError):  # gone, or another user's
            continue
        if process := find_process(pid):
            found.append(process)
    return found


def await_marks(pid: int, patience: float = 1.0) -> None:
    """Wait until :func:`marked` can find a child that was just started: the kernel shows its environment a moment after ``exec``.

    Returns after ``patience`` seconds in any case, and at once for a process that has ended.
    """
    deadline = time.monotonic() + patience
    with contextlib.suppress(OSError):
        while find_process(pid) and time.monotonic() < deadline:
            with open(f"/proc/{pid}/environ", "rb") as file:
                if file.read(1):
                    return
            time.sleep(0.001)


def end_all(
    find: Callable[[], Sequence[Process]],
    patience: float = PATIENCE,
    strike: Callable[[Sequence[Process]], None] | None = None,
) -> Sequence[Process]:
    """Kill what ``find`` returns until it returns nothing.

    Args:
        find: Returns the processes that have to end. It is called again after each kill, since they may start others meanwhile.
        patience: Seconds after which this gives up.
        strike: Kills the found processes; by default with SIGKILL to each.

    Returns:
        The processes that remain after ``patience``; normally none.
    """
    deadline, pause = time.monotonic() + patience, 0.001
    while left := find():
        (strike or kill)(left)
        if time.monotonic() > deadline:
            return find()
        time.sleep(pause)
        pause = min(2 * pause, _LONGEST_PAUSE)
    return ()


def kill(processes: Sequence[Process]) -> None:
    """Send SIGKILL to each; skip those that are gone or belong to another user."""
    for process in processes:
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.kill(process.pid, signal.SIGKILL)


def unkillable(left: Sequence[Process]) -> str:
    """One clause that names processes that survived SIGKILL, and their host."""
    more = f" and {len(left) - 3} more" if len(left) > 3 else ""
    named = "; ".join(str(process) for process in left[:3])
    return f"SIGKILL does not end {named}{more} on host {socket.gethostname()}"


def _pids() -> list[int]:
    return [int(entry) for entry in os.listdir("/proc") if entry.isdigit()]
