"""Control groups (version 2) around nodes: nothing that a node starts can leave its group, whatever sessions and forks it hides behind.

They are used where this process may make one below its own: as root, or where it was delegated (``systemd-run --user --scope -p
Delegate=yes``). Whether it may is found out by trying. No controller is enabled in them. Linux only.
"""

from __future__ import annotations

import contextlib
import errno
import os
import time

from shared_store.processes import Process, find_process

_TRIES = 25
_NEW = 60.0
"""Seconds within which a process is about to enter a group that was made."""


def own_group() -> str:
    """Directory of the control group that this process is in; empty where it can't make groups below it."""
    try:
        with open("/proc/self/cgroup") as file:
            path = next(line[3:].rstrip("\n") for line in file if line.startswith("0::"))
        with open("/proc/self/mountinfo") as file:
            mounts = [line.partition(" - ") for line in file]
        root, point = next(head.split()[3:5] for head, _, tail in mounts if tail.startswith("cgroup2 "))
        directory = os.path.normpath(os.path.join(point, os.path.relpath(path, root)))
        trial = os.path.join(directory, f"muster-trial-{os.getpid()}-{time.monotonic_ns()}")
        os.mkdir(trial)
        os.rmdir(trial)
    except (OSError, StopIteration):
        return ""
    return directory


def members(group: str) -> list[Process]:
    """Processes in the group and in groups below it; none where there is no such group."""
    found = []
    for directory, _, _ in os.walk(group):
        try:
            with open(os.path.join(directory, "cgroup.procs")) as file:
                pids = file.read().split()
        except OSError as error:
            if error.errno in (errno.ENOENT, errno.ENODEV):  # it was removed, before or after it was opened
                continue
            raise
        found += [process for pid in pids if (process := find_process(int(pid)))]
    return found


def kill_group(group: str) -> None:
    """SIGKILL to all of the group at once, where the kernel can (Linux 5.14); nothing where ``group`` is empty."""
    if not group:
        return
    with contextlib.suppress(OSError):
        file = os.open(f"{group}/cgroup.kill", os.O_WRONLY)  # not open(): it must not make one
        try:
            os.write(file, b"1")
        finally:
            os.close(file)


def remove_group(group: str) -> None:
    """Remove the group and those below it; one that is not empty, or not there, is left alone."""
    for _ in range(_TRIES):
        for directory, _, _ in os.walk(group, topdown=False):
            with contextlib.suppress(OSError):
                os.rmdir(directory)
        if not os.path.isdir(group):
            return
        time.sleep(0.02)  # processes that have just died still count for a moment


def remove_abandoned_groups(directory: str) -> None:
    """Remove groups of nodes below ``directory`` that are empty and not new: left by shims that were killed while no controller stopped the gang."""
    for entry in os.scandir(directory) if directory else ():
        with contextlib.suppress(OSError):  # the kernel refuses where a process is in it
            if entry.name.startswith("muster-") and time.time() - entry.stat().st_mtime > _NEW:
                os.rmdir(entry.path)
