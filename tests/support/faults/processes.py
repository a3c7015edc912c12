"""The processes of one home directory, by what they are; found in ``/proc``, as a stranger would."""

from __future__ import annotations

import os
import signal
from dataclasses import dataclass, replace
from pathlib import Path

_ROLES = {b"worker.supervisor": "supervisor", b"worker.saver": "writer", b"worker.train": "rank"}


@dataclass(frozen=True)
class Process:
    """A living process of a gang; pid and start time [clock ticks since boot] name it for ever."""

    pid: int
    start: str
    role: str
    """``supervisor``, ``rank``, ``writer`` or ``other``."""
    gang: str
    """``<job>/<attempt>/<epoch>``, as the engine called it."""
    number: int
    """Of the rank, or of the rank that the writer serves, or of the node."""

    def strike(self, number: int) -> bool:
        """Send signal ``number``; False where the process is gone already."""
        if _stat(self.pid)[1] != self.start:
            return False
        try:
            os.kill(self.pid, number)
        except ProcessLookupError:
            return False
        return True

    def __str__(self) -> str:
        return f"{self.role} {self.number} (pid {self.pid})"


def processes_below(home: Path) -> list[Process]:
    """Every process, zombies left out, whose environment names a store below ``home``."""
    wanted = f"MUSTER_STORE={home}/".encode()
    found = []
    for entry in os.listdir("/proc"):
        if not entry.isdigit():
            continue
        try:
            raw = Path(f"/proc/{entry}/environ").read_bytes()
            if wanted not in raw:
                continue
            command = Path(f"/proc/{entry}/cmdline").read_bytes().split(b"\0")
        except OSError:
            continue
        state, start = _stat(int(entry))
        if state in "ZX":
            continue
        env = dict(item.split(b"=", 1) for item in raw.split(b"\0") if b"=" in item)
        role = next((_ROLES[word] for word in command[:5] if word in _ROLES), "other")
        number = int(env.get(b"RANK") or env.get(b"AWS_BATCH_JOB_NODE_INDEX") or -1)
        found.append(Process(int(entry), start, role, env.get(b"MUSTER_GANG", b"").decode(), number))
    ranks = {process.pid for process in found if process.role == "rank"}
    forked = {process.pid for process in found if process.pid in ranks and _parent(process.pid) in ranks}
    return [replace(process, role="other") if process.pid in forked else process for process in found]  # writers to be


def _parent(pid: int) -> int:
    try:
        return int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[1])
    except OSError:
        return 0


def end_all(home: Path) -> None:
    """SIGKILL for whatever is left below ``home``."""
    while left := processes_below(home):
        for process in left:
            process.strike(signal.SIGKILL)


def _stat(pid: int) -> tuple[str, str]:
    """State and start time; ``Z`` and nothing where there is no such process."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        return fields[0], fields[19]
    except OSError:
        return "Z", ""
