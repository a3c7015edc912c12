"""Control groups (cgroups, version 2) around nodes: no process of a node can leave its group, whatever sessions and forks it uses.

They are used if this process may create groups below its own: as root, or with delegation (``systemd-run --user --scope -p
Delegate=yes``). A trial decides. Of the controllers only that of memory is used: :mod:`shared_store.process.memory_groups`. Linux only.
"""

from __future__ import annotations

import contextlib
import errno
import os
import time

from shared_store.process.processes import Process, find_process

CONTROLLER = "muster"
"""Name of the group of the controller inside a delegated one: its own, or that of systemd's ``DelegateSubgroup=``."""
_TRIES = 25
_NEW = 60.0
"""Seconds after its creation within which a group may still be waiting for its process."""


def own_group() -> str:
    """Directory of version 2 below which this process can create control groups; empty if it can't.

    It is this process's own, or the one above where that was made for the controller in a group that was delegated to it.
    """
    directory = find_group("")
    above, name = os.path.split(directory)
    return above if name == CONTROLLER and is_delegated(above) else directory


def is_delegated(group: str) -> bool:
    """Whether systemd leaves the group to its processes."""
    for name in ("user.delegate", "trusted.delegate"):
        with contextlib.suppress(OSError):
            if os.getxattr(group, name) == b"1":
                return True
    return False


def find_group(controller: str) -> str:
    """Directory of this process's control group; empty if it can't create groups below it.

    Args:
        controller: A controller of version 1; empty for version 2, which has one group for all.
    """
    try:
        with open("/proc/self/cgroup") as file:
            lines = [line.rstrip("\n").split(":", 2) for line in file]
        path = next(path for _, names, path in lines if controller in names.split(","))
        with open("/proc/self/mountinfo") as file:
            mounts = [(head.split()[3:5], tail.split()) for head, _, tail in (line.partition(" - ") for line in file)]
        root, point = next(
            place
            for place, (kind, _, options, *_) in mounts
            if (kind == "cgroup" and controller in options.split(",") if controller else kind == "cgroup2")
        )
        directory = os.path.normpath(os.path.join(point, os.path.relpath(path, root)))
        trial = os.path.join(directory, f"muster-trial-{os.getpid()}-{time.monotonic_ns()}")
        os.mkdir(trial)
        os.rmdir(trial)
    except (OSError, StopIteration):
        return ""
    return directory


def members(group: str) -> list[Process]:
    """Processes in the group and in groups below it; none if the group does not exist."""
    found = []
    for directory, _, _ in os.walk(group):
        try:
            with open(os.path.join(directory, "cgroup.procs")) as file:
                pids = file.read().split()
        except OSError as error:
            if error.errno in (errno.ENOENT, errno.ENODEV):  # removed, before or after it was opened
                continue
            raise
        found += [process for pid in pids if (process := find_process(int(pid)))]
    return found


def write_control(path: str, text: str) -> None:
    """Write a control file, which must exist. Raises OSError."""
    file = os.open(path, os.O_WRONLY)  # not open(): it must not make one
    try:
        os.write(file, text.encode())
    finally:
        os.close(file)


def kill_group(group: str) -> None:
    """Send SIGKILL to the whole group at once, if the kernel can (Linux 5.14); do nothing if ``group`` is empty."""
    with contextlib.suppress(OSError):
        if group:
            write_control(f"{group}/cgroup.kill", "1")


def remove_group(group: str) -> None:
    """Remove the group and those below it; leave groups alone that have processes or do not exist, and do nothing for an empty text."""
    for _ in range(_TRIES if group else 0):
        _remove_below(group)
        if not os.path.isdir(group):
            return
        time.sleep(0.02)  # processes still count for a moment after their death


def remove_abandoned_groups(directory: str) -> None:
    """Remove empty, old groups of nodes below ``directory``: leftovers of shims that were killed while no controller stopped the gang."""
    for entry in os.scandir(directory) if directory else ():
        with contextlib.suppress(OSError):
            if entry.name.startswith("muster-") and time.time() - entry.stat().st_mtime > _NEW:
                _remove_below(entry.path)


def _remove_below(group: str) -> None:
    """Remove a group and those below it, as far as they are empty: the kernel refuses those with processes."""
    for directory, _, _ in os.walk(group, topdown=False):
        with contextlib.suppress(OSError):
            os.rmdir(directory)
