"""Forks of a process that has imported what ranks import: nodes of this machine (:mod:`worker.fork_server`)."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import threading
from collections.abc import Mapping, Sequence
from contextlib import suppress

from orchestrator.engines.toolkit.environment import inherited, node_environment
from shared_store.process.forking import PADDING, early, receive, send

_PADDING = 16384
"""Bytes for the variables that a rank shows of its own."""
_prepared: list[ForkServer] = []


def prepare() -> None:
    """Start a fork server for the local engine of this process, which will be made later."""
    with suppress(OSError):
        _prepared.append(ForkServer())


def prepared() -> ForkServer | None:
    """The one of :func:`prepare`; its caller closes it."""
    return _prepared.pop() if _prepared else None


class ForkServer:
    """Starts at once, and imports meanwhile."""

    def __init__(self) -> None:
        """Raises OSError."""
        self._turn = threading.Lock()
        environment = node_environment(inherited(), "", {}, {})
        self._early = early(environment)
        # one thread: those of a numerical library would not survive a fork, and a rank sets its own number
        environment = {"OMP_NUM_THREADS": "1", **environment, "PYTHONUNBUFFERED": "1", PADDING: "-" * _PADDING}
        self._channel, theirs = socket.socketpair()
        with theirs:
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-m", "worker.fork_server", str(theirs.fileno())],
                env=environment,
                cwd="/",
                pass_fds=(theirs.fileno(),),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
            )

    def fits(self, environment: Mapping[str, str]) -> bool:
        """Whether a node with these variables may be forked: no library has read another value while it was imported."""
        return early(environment) == self._early and self._process.poll() is None

    def fork(
        self, command: Sequence[str], environment: Mapping[str, str], directory: str | None, errors: int, ranks: int
    ) -> int:
        """Fork a node; returns its shim's pid.

        Args:
            command: Of its shim.
            environment: All its variables.
            directory: Its working directory; None: that of this process.
            errors: Descriptor of its standard error.
            ranks: Number of ranks.

        Raises:
            OSError: The server has ended.
        """
        message = {
            "command": list(command),
            "environment": dict(environment),
            "directory": directory or os.getcwd(),
            "ranks": ranks,
        }
        with self._turn:
            send(self._channel, message, [errors])
            answer = receive(self._channel)
        if answer is None:
            raise ConnectionResetError("the fork server has ended")
        return int(answer[0]["pid"])

    def become(self, module: str, arguments: Sequence[str], environment: Mapping[str, str]) -> subprocess.Popen[bytes]:
        """Have the server itself run a part of the worker, with this process's standard streams and directory; returns the process.

        Raises:
            OSError: The server has ended.
        """
        message = {
            "module": module,
            "arguments": [*arguments],
            "environment": dict(environment),
            "directory": os.getcwd(),
        }
        send(self._channel, message, (0, 1, 2))
        self._channel.close()
        return self._process

    def close(self) -> None:
        """End it. The nodes go on."""
        self._channel.close()
        self._process.kill()
        self._process.wait()
