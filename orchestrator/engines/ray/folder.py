"""The folder of a Ray job, ``$MUSTER_HOME/ray/<job>/``: files and a named pipe with messages between the engine and the job's driver.

The driver outlives the controller. Whoever finds a reader at the pipe's other end has found it; what it knows is in its state files.
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
"""Seconds without a sign of life between a driver and an actor after which each gives the other up: an actor ends its node."""

UNSTARTED = ("joining", "placing", "starting")
"""Phases of a gang before any command was started."""

NEW = "ray/+"
"""Names of hosts that the autoscaler could add begin so."""


class Folder:
    """One job's folder."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.pipe = path / "commands"
        self.said = path / "driver.err"
        self.alive = path / "alive"
        """Touched by the driver every second."""

    @classmethod
    def of(cls, home: Path, job: str) -> Folder:
        return cls(home / "ray" / job)

    def make(self) -> None:
        """Make the folder, for its owner only (plans hold the job's environment), and the pipe."""
        self.path.mkdir(mode=0o700, parents=True, exist_ok=True)
        self.path.chmod(0o700)
        if not (self.pipe.exists() and stat.S_ISFIFO(self.pipe.stat().st_mode)):
            with contextlib.suppress(FileExistsError):
                os.mkfifo(self.pipe, 0o600)

    def read_end(self) -> int:
        """A descriptor of the pipe that reads, and that never sees its end; a driver is born with one."""
        return os.open(self.pipe, os.O_RDWR | os.O_NONBLOCK)

    def send(self, command: Mapping[str, Any]) -> bool:
        """Tell the driver; False where there is none. One that is too busy to read is one that is there."""
        try:
            descriptor = os.open(self.pipe, os.O_WRONLY | os.O_NONBLOCK)
        except OSError as error:
            if error.errno in (errno.ENXIO, errno.ENOENT):
                return False
            raise
        try:
            os.write(descriptor, json.dumps(command).encode() + b"\n")
        except BlockingIOError:
            pass
        finally:
            os.close(descriptor)
        return True

    def is_driven(self) -> bool:
        """Whether the job's driver is there. Raises OSError where that can't be told now."""
        try:
            os.close(os.open(self.pipe, os.O_WRONLY | os.O_NONBLOCK))
            return True
        except OSError as error:
            if error.errno in (errno.ENXIO, errno.ENOENT):
                return False
            raise

    def last_line(self) -> str:
        """The last line that a driver of the job wrote before it ended."""
        return self.said.read_text(errors="replace").strip().rpartition("\n")[2] if self.said.exists() else ""

    def plan(self, gang: str) -> Path:
        return self.path / f"{_file_name(gang)}.plan.json"

    def state(self, gang: str) -> Path:
        return self.path / f"{_file_name(gang)}.state.json"


def _file_name(gang: str) -> str:
    """``<attempt>-<epoch>``, of ``<job>/<attempt>/<epoch>``."""
    return gang.partition("/")[2].replace("/", "-")
