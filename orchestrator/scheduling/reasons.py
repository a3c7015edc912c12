"""Why a job waits, in words that a person can act on; put together only for the jobs that somebody asks about."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cached_property
from math import inf
from typing import Protocol

from orchestrator.scheduling.head import Head
from orchestrator.scheduling.lane import NO_ROOM, Lane
from orchestrator.scheduling.placement import EPSILON, count_of, needs, together
from orchestrator.scheduling.room import Room
from orchestrator.scheduling.snapshot import Shape, Waiting

NO_POOL = "ACTION_REQUIRED - CE(s) associated with the job queue are invalid."
_NAMED = 3
"""How many jobs a reason names."""


@dataclass(frozen=True)
class Line:
    """The jobs of one queue that wait, in their order."""

    jobs: Sequence[Waiting]
    lane: Lane | None
    """None: there is no such queue."""


class _Preemption(Protocol):
    @property
    def job(self) -> str: ...
    @property
    def by(self) -> str: ...


class Board:
    """What a pass leaves behind: each queue's order, and each waiting job's reason. Decided once, worded on request."""

    def __init__(
        self,
        now: int,
        lines: Mapping[str, Line],
        heads: Sequence[Head],
        room: Room,
        preempts: Sequence[_Preemption],
        drift: int = 0,
    ) -> None:
        """Args:
        now: Time of the pass [ms].
        lines: By queue.
        heads: In the order in which they came.
        room: What is free after the pass.
        preempts: Who is preempted, by whom.
        drift: What times lack to be Unix time [ms].
        """
        self._drift = drift
        self._now, self._lines, self._heads, self._room = now, lines, {head.job.job: head for head in heads}, room
        self._preempted = {each.job for each in preempts}
        self._orders: dict[str, tuple[str, ...]] = {}
        self._common: dict[tuple[str, Shape], tuple[bool, str]] = {}

    def order(self, queue: str) -> Sequence[str]:
        """Ids of the queue's waiting jobs, the first to be served first; empty for a queue where none waits."""
        if queue not in self._orders:
            line = self._lines.get(queue)
            self._orders[queue] = tuple(job.job for job in line.jobs) if line else ()
        return self._orders[queue]

    def reason(self, job: str) -> str:
        """The ``statusReason`` of a job that waits. Raises KeyError for one that starts, is cancelled or was not waiting."""
        queue, position = self._positions[job]
        line = self._lines[queue]
        if line.lane is None or not line.lane.pools:
            return NO_POOL
        if head := self._heads.get(job):
            return f"{NO_ROOM} - {self._free(head.job.shape, head.seat.pool)}{self._until(head)}"
        key = (queue, line.jobs[position].shape)
        if key not in self._common:
            self._common[key] = self._common_reason(queue, line.lane, key[1])
        behind, text = self._common[key]
        if not behind:
            return text
        # AWS gives a code to the first job of a queue only: that is the one that is stuck
        code = f"{NO_ROOM} - " if position == 0 else ""
        return f"{code}{_ordinal(position + 1)} in queue {queue}, {text}"

    def _common_reason(self, queue: str, lane: Lane, shape: Shape) -> tuple[bool, str]:
        """What all jobs of a shape in a queue wait for, and whether it is behind another one."""
        if reason := lane.impossible(shape) or lane.barred(shape):
            return False, reason
        before = self._before(queue, lane, shape)
        if before is None:
            return False, f"{NO_ROOM} - {self._free(shape, lane.possible(shape)[0])}"
        wants = f"{needs(before.job.shape)}{self._start(before, ' and starts by ')}"
        name = _named(before.job.name, before.job.job)
        return True, f"behind job {name}, which {wants}{self._hint(shape, lane)}"

    @cached_property
    def _positions(self) -> dict[str, tuple[str, int]]:
        """Queue and place in its order (from 0) of every job that waits."""
        return {job.job: (queue, i) for queue, line in self._lines.items() for i, job in enumerate(line.jobs)}

    def _before(self, queue: str, lane: Lane, shape: Shape) -> Head | None:
        """The head that a job waits behind: one of its own queue, else the first that keeps hosts it could use."""
        hosts = {host for pool in lane.possible(shape) for host in self._room.members[pool]}
        heads = [head for head in lane.heads if not head.hosts.isdisjoint(hosts)]
        return next((head for head in heads if head.job.queue == queue), heads[0] if heads else None)

    def _free(self, shape: Shape, pool: str) -> str:
        """What the shape needs, what is free of the pool, and why that is not enough where it looks as if it were."""
        hosts = [self._room.hosts[name] for name in self._room.members[pool]]
        if self._room.cpus[pool] + EPSILON < shape.least.cpus:
            left = count_of(max(0.0, self._room.cpus[pool]), "CPU")
            return f"{needs(shape)}; compute environment {pool} may use {left} more at this time"
        least = shape.least
        enough = (
            sum(host.cpus for host in hosts) + EPSILON >= least.cpus
            and sum(len(host.gpus) for host in hosts) >= least.gpus
            and sum(host.memory for host in hosts) >= least.memory
        )
        return f"{needs(shape)}; {together(hosts)} free{', but not in one piece for each node' if enough else ''}"

    def _until(self, head: Head) -> str:
        """Whose end the head waits for, and when that is at the latest."""
        preempted = [each for each in head.awaits if each.job in self._preempted]
        awaited = preempted or list(head.awaits)
        if not awaited:
            return ""
        names = [_named(each.name, each.job) for each in awaited[-_NAMED:]]
        others = len(awaited) - len(names)
        who = ", ".join(names) + (f" and {others} more" if others else "")
        plural = "s" if len(awaited) > 1 else ""
        if preempted:
            return f" until job{plural} {who}, preempted for it, {'have' if plural else 'has'} stopped"
        if all(each.ending for each in awaited):
            return f" until job{plural} {who} {'have' if plural else 'has'} stopped"
        return f" until job{plural} {who} end{'' if plural else 's'}{self._start(head, ', at the latest at ')}"

    def _start(self, head: Head, lead: str) -> str:
        """When the head starts at the latest; nothing where nobody knows or it is about to."""
        if not self._now < head.spare.at < inf:
            return ""
        return lead + datetime.fromtimestamp((head.spare.at + self._drift) / 1000, UTC).strftime(
            "%Y-%m-%d %H:%M:%S UTC"
        )

    def _hint(self, shape: Shape, lane: Lane) -> str:
        """That the shape would fit now, and with which timeout it could start without delaying anybody."""
        pools = lane.open(shape)
        if not any(self._room.seat(shape, pool) for pool in pools):
            return ""
        kept = "; it would fit now, but on what is kept for that job"
        unknown = [head.spare for head in lane.heads if head.spare.at == inf]
        seconds = int((lane.times[0] - self._now) / 1000) if lane.times else 0
        if seconds < 1 or not any(self._room.seat(shape, pool, unknown) for pool in pools):
            return kept
        return f"{kept}: with a timeout of at most {seconds} s it could start"


def _named(name: str, job: str) -> str:
    return f"{name} ({job[:8]})"


def _ordinal(number: int) -> str:
    if number % 100 in (11, 12, 13):
        return f"{number}th"
    return f"{number}{ {1: 'st', 2: 'nd', 3: 'rd'}.get(number % 10, 'th') }"
