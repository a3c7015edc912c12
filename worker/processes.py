"""What a node does to processes: adopt orphans, end everything it ever started.

Linux only: it uses ``prctl(2)`` and ``/proc``. Imports no torch.
"""

from __future__ import annotations

import ctypes
import os
import signal
from pathlib import Path

_PR_SET_CHILD_SUBREAPER = 36
_libc = ctypes.CDLL(None, use_errno=True)


def adopt_orphans() -> None:
    """Have descendants whose parent dies re-parented to this process instead of to init, so that they can be found."""
    _libc.prctl(_PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)


def children() -> list[int]:
    """Pids of the processes whose parent is this process, zombies left out."""
    me = os.getpid()
    found = []
    for entry in Path("/proc").iterdir():
        if not entry.name.isdigit():
            continue
        try:
            # field 2 is the command in brackets, which may hold spaces: split after the last bracket
            state, parent = (entry / "stat").read_text().rpartition(")")[2].split()[:2]
        except OSError:
            continue
        if int(parent) == me and state != "Z":
            found.append(int(entry.name))
    return found


def kill_group(pid: int, number: int) -> None:
    """Send signal ``number`` to the process group that ``pid`` leads, where it still exists."""
    try:
        os.killpg(pid, number)
    except (ProcessLookupError, PermissionError):
        pass


def reap_orphans() -> None:
    """Kill and reap every child that is left, and theirs, until there is none."""
    while pids := children():
        for pid in pids:
            try:
                os.kill(pid, signal.SIGKILL)
                os.waitpid(pid, 0)
            except (ProcessLookupError, ChildProcessError):
                pass
