"""A rank that was forked from a process which has imported what it needs, and waits for this supervisor's word."""

from __future__ import annotations

import os
import socket
from collections.abc import Mapping
from pathlib import Path
from typing import IO

from shared_store.process.forking import RANKS, send


class ForkedRank:
    """As much of ``subprocess.Popen`` as a supervisor needs.

    Args:
        pid: Of the process, a child of this one.
        channel: Where it waits.
        module: What it runs.
        environment: All its variables.
        directory: Its working directory; None: that of this process.
        progress: Descriptor to which it writes its messages.
    """

    def __init__(
        self,
        pid: int,
        channel: int,
        module: str,
        environment: Mapping[str, str],
        directory: Path | None,
        progress: int,
    ) -> None:
        self.pid = pid
        self._code: int | None = None
        (output, theirs_out), (errors, theirs_err) = os.pipe(), os.pipe()
        self.stdout: IO[bytes] | None = os.fdopen(output, "rb")
        self.stderr: IO[bytes] | None = os.fdopen(errors, "rb")
        message = {
            "module": module,
            "environment": dict(environment),
            "directory": directory and str(directory),
        }
        nothing = os.open(os.devnull, os.O_RDONLY)
        theirs = (nothing, theirs_out, theirs_err)
        try:
            with socket.socket(fileno=channel) as waiting:
                send(waiting, message, (*theirs, progress))
        except OSError:
            pass  # it has ended: poll() says how
        for each in theirs:
            os.close(each)

    def poll(self) -> int | None:
        """Its exit code, negative for a signal; None while it runs."""
        if self._code is None:
            pid, status = os.waitpid(self.pid, os.WNOHANG)
            if pid:
                self._code = os.waitstatus_to_exitcode(status)
        return self._code


def forked_ranks() -> list[tuple[int, int]]:
    """The pid and the descriptor of each rank that waits for this supervisor."""
    listed = os.environ.pop(RANKS, "")
    found = []
    for each in filter(None, listed.split(",")):
        pid, _, descriptor = each.partition(":")
        os.set_inheritable(int(descriptor), False)
        found.append((int(pid), int(descriptor)))
    return found
