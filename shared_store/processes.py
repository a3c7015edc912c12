"""Processes of this machine as ``/proc`` shows them: whose descendants they are, what marks they carry, how they are ended for good.

Linux only. Imports nothing that is slow to load: the node's shim uses it.
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
"""Seconds after which a process that has not ended from SIGKILL counts as one that can't be killed."""
_LONGEST_PAUSE = 0.5
"""Seconds between two tries to end what is left."""
_STATES = {
    "D": "in an uninterruptible wait for a device, a file system or a frozen control group",
    "T": "stopped",
    "t": "traced by a debugger",
}


@dataclass(frozen=True)
class Process:
    """A process that is neither a zombie nor gone; pid and start time identify it."""

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
    """The process with that id; None where it is gone or a zombie.

    Raises OSError where it can't be looked at now, without free descriptors for instance: that is not the end of a process.
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
    """Pids of the direct children of process ``of``, zombies included: fast, but not on every kernel, and without a guarantee."""
    try:
        with open(f"/proc/{of}/task/{of}/children") as file:
            return [int(pid) for pid in file.read().split()]
    except OSError:
        return []


def marked(marks: Collection[str]) -> list[Process]:
    """Processes, other than this one, that have all of ``marks`` (``NAME=VALUE``) in their environment.

    Raises ValueError without a mark: every process of the machine would have all of none. Raises OSError as above.
    """
    wanted = {mark.encode() for mark in marks}
    if not wanted or any(not mark.partition(b"=")[2] for mark in wanted):
        raise ValueError(f"no process can be told by the marks {sorted(marks)}")
    found = []
    for pid in _pids():
        if pid == os.getpid():
            continue
        try:
            with open(f"/proc/{pid}/environ", "rb") as file:
                if not wanted <= set(file.read().split(b"\0")):
                    continue
        except (FileNotFoundError, ProcessLookupError, PermissionError):  # gone, or another user's
            continue
        if process := find_process(pid):
            found.append(process)
    return found


def end_all(
    find: Callable[[], Sequence[Process]],
    patience: float = PATIENCE,
    strike: Callable[[Sequence[Process]], None] | None = None,
) -> Sequence[Process]:
    """Kill what ``find`` returns until it returns nothing.

    Args:
        find: Looks for the processes that have to end. It is asked again after each kill: they may start others meanwhile.
        patience: Seconds after which this gives up.
        strike: Kills what was found; by default SIGKILL to each.

    Returns:
        What was left when the patience was over; empty in all ordinary cases.
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
    """SIGKILL to each; those that are gone or belong to another user are passed over."""
    for process in processes:
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.kill(process.pid, signal.SIGKILL)


def unkillable(left: Sequence[Process]) -> str:
    """One clause that names processes that did not end from SIGKILL, and where they are."""
    more = f" and {len(left) - 3} more" if len(left) > 3 else ""
    named = "; ".join(str(process) for process in left[:3])
    return f"SIGKILL does not end {named}{more} on host {socket.gethostname()}"


def _pids() -> list[int]:
    return [int(entry) for entry in os.listdir("/proc") if entry.isdigit()]
