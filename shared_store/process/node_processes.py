"""The reliable end of a node's processes: from inside, by the shim or the supervisor, and from outside, by the engine. Linux only."""

from __future__ import annotations

import contextlib
import os
import signal
import time
from collections.abc import Collection, Sequence
from dataclasses import dataclass

from shared_store.process.cgroups import kill_group, members, remove_group
from shared_store.process.processes import PATIENCE, Process, children, descendants, end_all, find_process, kill, marked

_CHASE = 200
"""Consecutive looks at a subreaper's children: a few catch even a process that keeps replacing itself by a child of its own."""


def end_descendants(patience: float = PATIENCE, group: str = "") -> Sequence[Process]:
    """Kill and reap all descendants of this process, a subreaper, and all processes of a control group.

    Args:
        patience: Seconds after which this gives up.
        group: Directory of the control group; empty for none.

    Returns:
        The processes that SIGKILL has not ended by then; normally none.
    """
    me = os.getpid()

    def left() -> Sequence[Process]:
        found = {process.pid: process for process in members(group)}
        while has_children():
            if below := descendants(me):
                found |= {process.pid: process for process in below}
                break
            _chase(me)  # a child exists that the look did not find
        return list(found.values())

    def strike(found: Sequence[Process]) -> None:
        kill_group(group)
        kill(found)
        _chase(me)

    return end_all(left, patience, strike)


def has_children() -> bool:
    """Whether this process has a living child; reaps dead ones."""
    try:
        while os.waitpid(-1, os.WNOHANG)[0]:
            pass
    except ChildProcessError:
        return False
    return True


def _chase(me: int) -> None:
    for _ in range(_CHASE):
        for pid in (pids := children(me)):
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.kill(pid, signal.SIGKILL)
        if not pids or not has_children():
            return


@dataclass(frozen=True)
class NodeProcesses:
    """The data that identify a node's processes."""

    pid: int
    """Of its shim."""
    start: str
    """The shim's start time in clock ticks since boot; with the pid it identifies it."""
    group: str
    """Directory of its control group; empty for none."""
    memory: str = ""
    """Directory of the group that limits its memory; empty for none."""

    @property
    def shim(self) -> Process | None:
        """The shim; None once it has ended, also if another process has its pid."""
        process = find_process(self.pid)
        return process if process is not None and process.start == self.start else None


def end_nodes(nodes: Sequence[NodeProcesses], marks: Collection[str]) -> Sequence[Process]:
    """Kill all remaining processes of nodes; their shims reap them and then exit by themselves.

    Args:
        nodes: Shims and control groups.
        marks: Variables (``NAME=VALUE``) of every process of the nodes, unless it removed them, and of no other process.

    Returns:
        The processes that SIGKILL has not ended within ``PATIENCE`` seconds; normally none.
    """
    give_up_on_shims = time.monotonic() + PATIENCE / 2

    def shims() -> dict[int, Process]:
        return {shim.pid: shim for node in nodes if (shim := node.shim)}

    def left() -> Sequence[Process]:
        found = {process.pid: process for node in nodes for process in members(node.group)}
        for pid in shims():
            found |= {process.pid: process for process in descendants(pid)}
        found |= {process.pid: process for process in marked(marks)}
        alive = shims()
        return [process for pid, process in found.items() if pid not in alive] or list(alive.values())

    def strike(found: Sequence[Process]) -> None:
        alive = shims()
        for pid in alive:
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.kill(pid, signal.SIGCONT)  # a job may have stopped it
        for node in nodes:
            kill_group(node.group)
        if time.monotonic() > give_up_on_shims or not any(process.pid in alive for process in found):
            kill(found)

    remaining = end_all(left, strike=strike)
    for node in nodes if not remaining else ():
        remove_group(node.memory)
        remove_group(node.group)
    return remaining
