"""A node's processes and their end for good: from inside, by the shim or the supervisor, and from outside, by the engine. Linux only."""

from __future__ import annotations

import contextlib
import os
import signal
import time
from collections.abc import Collection, Sequence
from dataclasses import dataclass

from shared_store.cgroups import kill_group, members, remove_group
from shared_store.processes import PATIENCE, Process, children, descendants, end_all, find_process, kill, marked

_CHASE = 200
"""Looks at the children of a subreaper in a row: one that replaces itself by a child of its own all the time is caught in few."""


def end_descendants(patience: float = PATIENCE, group: str = "") -> Sequence[Process]:
    """Kill and reap all descendants of this process, a subreaper, and all of a control group.

    Args:
        patience: Seconds after which this gives up.
        group: Directory of the control group; empty for none.

    Returns:
        What SIGKILL has not ended by then; empty in all ordinary cases.
    """
    me = os.getpid()

    def left() -> Sequence[Process]:
        found = {process.pid: process for process in members(group)}
        while has_children():
            if below := descendants(me):
                found |= {process.pid: process for process in below}
                break
            _chase(me)  # there is one, and it was not where it was looked for
        return list(found.values())

    def strike(found: Sequence[Process]) -> None:
        kill_group(group)
        kill(found)
        _chase(me)

    return end_all(left, patience, strike)


def has_children() -> bool:
    """Whether this process has a child that lives; reaps those that do not."""
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
    """What finds the processes of a node."""

    pid: int
    """Of its shim."""
    start: str
    """The shim's start time in clock ticks since boot; with the pid it identifies it."""
    group: str
    """Directory of its control group; empty for none."""

    @property
    def shim(self) -> Process | None:
        """None once it has ended, also where its pid was given to another process."""
        process = find_process(self.pid)
        return process if process is not None and process.start == self.start else None


def end_nodes(nodes: Sequence[NodeProcesses], marks: Collection[str]) -> Sequence[Process]:
    """Kill all that is left of nodes; their shims reap it and then leave by themselves.

    Args:
        nodes: Shims and control groups.
        marks: Variables (``NAME=VALUE``) that every process of the nodes, and no other, has unless it took them out.

    Returns:
        The processes that SIGKILL has not ended within ``PATIENCE`` seconds; empty in all ordinary cases.
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
        remove_group(node.group)
    return remaining
