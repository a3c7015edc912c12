"""The folder of a Ray job, ``$MUSTER_HOME/ray/<job>/``: files and a named pipe with messages between the engine and the job's driver.

The driver outlives the controller. A reader at the pipe's other end is the driver; its state files hold what it knows.
"""

from __future__ import annotations

import contextlib
import errno
import json
import os
import stat
from collections.abc import Mapping
from pathlib import Path
from typing import Any

LEASE = 20.0
"""Seconds without a heartbeat between a driver and an actor after which each gives the other up: an actor ends its node."""

UNSTARTED = ("joining", "placing", "starting")
"""Phases of a gang before any command was started."""

NEW = "ray/+"
"""Names of hosts that the autoscaler could add begin so."""


class Folder:
    """One job's folder."""

    def __init__(self, path: Path) -> None:
        self.path, self.pipe = path, path / "commands"
        self.errors = path / "driver.err"
        self.alive = path / "alive"
        """Touched by the driver every second."""

    @classmethod
    def of(cls, home: Path, gang: str) -> Folder:
        """That of the job of a gang ``<job>/<attempt>/<epoch>``, or of a job."""
        return cls(home / "ray" / gang.partition("/")[0])

    def make(self) -> None:
        """Make the folder, for its owner only (plans hold the job's environment), and the pipe."""
        self.path.mkdir(mode=0o700, parents=True, exist_ok=True)
        self.path.chmod(0o700)
        if not (self.pipe.exists() and stat.S_ISFIFO(self.pipe.stat().st_mode)):
            with contextlib.suppress(FileExistsError):
                os.mkfifo(self.pipe, 0o600)

    def send(self, command: Mapping[str, Any] | None = None) -> bool:
        """Tell the driver; returns whether there is one. One that is too busy to read is one that is there. Raises OSError."""
        try:
            descriptor = os.open(self.pipe, os.O_WRONLY | os.O_NONBLOCK)
        except OSError as error:
            if error.errno in (errno.ENXIO, errno.ENOENT):
                return False
            raise
        try:
            if command is not None:
                os.write(descriptor, json.dumps(command).encode() + b"\n")
        except BlockingIOError:
            pass
        finally:
            os.close(descriptor)
        return True

    def last_line(self) -> str:
        """The last line that a driver of the job wrote before it ended."""
        return self.errors.read_text(errors="replace").strip().rpartition("\n")[2] if self.errors.exists() else ""

    def plan(self, gang: str) -> Path:
        """``<attempt>-<epoch>.plan.json``."""
        return self._file(gang, "plan")

    def state(self, gang: str) -> Path:
        return self._file(gang, "state")

    def _file(self, gang: str, kind: str) -> Path:
        return self.path / f"{gang.partition('/')[2].replace('/', '-')}.{kind}.json"
