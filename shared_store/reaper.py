"""Ends what a process leaves behind, however it ends: ``python -I -S reaper.py MARK ...``, with a pipe of that process as standard input.

A node's supervisor and ranks are tied to the process that started them (:mod:`shared_store.tied`), but what a rank started in a session
of its own is not. All of it carries the node's marks, variables of its environment. The reaper itself must not. Linux only.
"""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Collection


def start_reaper(marks: Collection[str]) -> subprocess.Popen[bytes]:
    """End everything that carries all of ``marks`` (``NAME=VALUE``) when this process has died. The caller keeps what is returned.

    In a session of its own, so that a signal to the caller's does not end it, too.
    """
    return subprocess.Popen(
        [sys.executable, "-I", "-S", __file__, *marks],
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        cwd="/",
        start_new_session=True,
    )


def end_marked(marks: Collection[str]) -> None:
    """SIGKILL to everything on this machine that carries all of the marks, but for this process, until nothing is left."""
    wanted = {mark.encode() for mark in marks}
    while pids := _marked(wanted):
        for pid in pids:
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.kill(pid, signal.SIGKILL)
        time.sleep(0.02)


def _marked(wanted: set[bytes]) -> list[int]:
    found = []
    for entry in os.listdir("/proc"):
        if not entry.isdigit() or int(entry) == os.getpid():
            continue
        try:
            with open(f"/proc/{entry}/environ", "rb") as file:
                if not wanted <= set(file.read().split(b"\0")):
                    continue
            with open(f"/proc/{entry}/stat") as status:
                if status.read().rpartition(")")[2].split()[0] not in "ZX":
                    found.append(int(entry))
        except OSError:
            continue
    return found


if __name__ == "__main__":
    while os.read(0, 1024):  # nobody writes: it ends when the last holder of the other end is gone
        pass
    end_marked(sys.argv[1:])
