"""A supervisor's operations on the processes of its ranks: adopt orphans, send signals.

Linux only: it uses ``prctl(2)`` and ``/proc``. Imports no torch.
"""

from __future__ import annotations

import ctypes
import os

_PR_SET_CHILD_SUBREAPER = 36
_libc = ctypes.CDLL(None, use_errno=True)


def adopt_orphans() -> None:
    """Have descendants whose parent dies re-parented to this process instead of to init, so that they can be found."""
    _libc.prctl(_PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)


def kill_group(pid: int, number: int) -> None:
    """Send signal ``number`` to the process group that ``pid`` leads, where it still exists."""
    try:
        os.killpg(pid, number)
    except (ProcessLookupError, PermissionError):
        pass
