"""The local engine's gangs as the machine has them: for a controller whose database does not know what it started."""

from __future__ import annotations

import os
from pathlib import Path

from shared_store.process.processes import find_process


def running_gangs(home: Path) -> dict[str, list[int]]:
    """Gangs that were started from this home directory and run now: by name, the process of each node to send SIGTERM to."""
    nodes: dict[int, str] = {}
    directory = f"{home.resolve() / 'supervisors'}/"
    for entry in os.listdir("/proc"):
        if entry.isdigit():
            try:
                # what a node's own processes, and no others, say on stderr goes to a file of this home
                if os.readlink(f"/proc/{entry}/fd/2").startswith(directory):
                    environment = Path(f"/proc/{entry}/environ").read_bytes().split(b"\0")
                    nodes |= {
                        int(entry): item[12:].decode() for item in environment if item.startswith(b"MUSTER_GANG=")
                    }
            except OSError:
                continue  # it is gone, or another user's
    found: dict[str, list[int]] = {}
    for pid, gang in nodes.items():
        if parent_of(pid) not in nodes:
            found.setdefault(gang, []).append(pid)
    return found


def parent_of(pid: int) -> int:
    """Pid of a process's parent; 0 for a process that is gone."""
    process = find_process(pid)
    return process.parent if process else 0
