"""Memory limits by control groups: of version 2, or of version 1's controller ``memory``. Linux only.

A node's group has the job's processes alone, not their supervisor, so that a limit means what it means for a container.
"""

from __future__ import annotations

import contextlib
import errno
import os

from shared_store.process.cgroups import CONTROLLER, find_group, is_delegated, write_control

_JOB = "job"


def memory_home(groups: str, *, arrange: bool = False) -> str:
    """Directory below which memory can be limited; empty if it can't. A trial decides.

    Args:
        groups: Directory in which control groups of nodes are made; empty where they can't be.
        arrange: Make way in a scope of version 2 that was delegated: its processes move into a group below it, since one that limits
            others must have none.
    """
    for home in (groups, find_group("memory")):
        if home and (not _is_newer(home) or _has_memory(home, arrange)):
            trial = f"{home}/muster-memory-{os.getpid()}"
            try:
                os.mkdir(trial)
                _limit(trial, 1 << 30)
                return home
            except OSError:
                continue
            finally:
                with contextlib.suppress(OSError):
                    os.rmdir(trial)
    return ""


def limits_memory(groups: str) -> bool:
    """Whether a controller that is started as this process was could limit memory; ``groups`` as in :func:`memory_home`."""
    if memory_home(groups):
        return True
    made_way = is_delegated(groups) and (groups.endswith(".scope") or not _words(f"{groups}/cgroup.procs"))
    return made_way and "memory" in _words(f"{groups}/cgroup.controllers")


def memory_group(home: str, name: str) -> str:
    """Directory of the memory group of a node, below ``home``; ``name``: of its control group, which has it inside in version 2."""
    return f"{home}/{name}/{_JOB}" if _is_newer(home) else f"{home}/{name}"


def make_memory_group(path: str, limit: int) -> None:
    """Make the memory group of the node whose supervisor this process is; ``limit`` in bytes. Raises OSError."""
    above = os.path.dirname(path)
    if _is_newer(above):  # this process is in it, and it must have none to limit others
        os.makedirs(f"{above}/supervisor", exist_ok=True)
        write_control(f"{above}/supervisor/cgroup.procs", "0")
        write_control(f"{above}/cgroup.subtree_control", "+memory")
    os.makedirs(path, exist_ok=True)
    _limit(path, limit)


def killed_for_memory(path: str) -> bool:
    """Whether the kernel has ended a process of the group because the memory was used up."""
    for name in ("memory.events", "memory.oom_control"):
        with contextlib.suppress(FileNotFoundError):
            words = _words(f"{path}/{name}")
            return int(dict(zip(words[::2], words[1::2], strict=False)).get("oom_kill", 0)) > 0
    return False


def _limit(path: str, limit: int) -> None:
    newer = _is_newer(path)
    write_control(f"{path}/{'memory.max' if newer else 'memory.limit_in_bytes'}", str(limit))
    with contextlib.suppress(FileNotFoundError):  # a kernel that does not count swap
        # of version 1 it is memory and swap together: none beyond the memory, either way
        name, most = ("memory.swap.max", 0) if newer else ("memory.memsw.limit_in_bytes", limit)
        write_control(f"{path}/{name}", str(most))


def _has_memory(home: str, arrange: bool) -> bool:
    """Whether groups below ``home``, of version 2, can be limited."""
    if not arrange:
        return "memory" in _words(f"{home}/cgroup.subtree_control")
    if "memory" not in _words(f"{home}/cgroup.controllers"):
        return False
    try:
        write_control(f"{home}/cgroup.subtree_control", "+memory")
        return True
    except OSError as error:
        # systemd starts a service's processes in its own group, also again while nodes of the last start run below it
        if error.errno != errno.EBUSY or not (is_delegated(home) and home.endswith(".scope")):
            return False
    try:
        os.makedirs(f"{home}/{CONTROLLER}", exist_ok=True)
        for pid in _words(f"{home}/cgroup.procs"):
            with contextlib.suppress(ProcessLookupError):
                write_control(f"{home}/{CONTROLLER}/cgroup.procs", pid)
        write_control(f"{home}/cgroup.subtree_control", "+memory")
    except OSError:
        return False
    return True


def _is_newer(directory: str) -> bool:
    """Whether it is a group of version 2."""
    return os.path.exists(f"{directory}/cgroup.controllers")


def _words(path: str) -> list[str]:
    with open(path) as file:
        return file.read().split()
