"""One scheduling pass: who starts now and where, who is preempted or cancelled for it, and why the others wait."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import inf

from orchestrator.engines.base import Placement
from orchestrator.scheduling.head import Head, Holder, end_of, holder_of, reserve, victims
from orchestrator.scheduling.lane import NO_ROOM, Lane
from orchestrator.scheduling.order import dispatch_order, turn
from orchestrator.scheduling.quota import quota_of
from orchestrator.scheduling.reasons import Board, Line
from orchestrator.scheduling.room import Room, Seat
from orchestrator.scheduling.snapshot import Leading, Queue, Snapshot, Waiting


@dataclass(frozen=True, slots=True)
class Start:
    """Launch the job's gang in this pool, one placement a node by index."""

    job: str
    pool: str
    placements: tuple[Placement, ...]


@dataclass(frozen=True, slots=True)
class Preempt:
    """Stop the gang of ``job`` (checkpoint, exit 75, requeue) so that the job ``by`` can start."""

    job: str
    by: str


@dataclass(frozen=True, slots=True)
class Cancel:
    """Fail the waiting job with this reason."""

    job: str
    reason: str


@dataclass(frozen=True)
class Decisions:
    """What the controller does now; the board tells why the other jobs wait."""

    starts: tuple[Start, ...]
    preempts: tuple[Preempt, ...]
    cancels: tuple[Cancel, ...]
    board: Board
    leading: Mapping[str, Leading]
    """By queue; for the next snapshot."""


def decide(snapshot: Snapshot) -> Decisions:
    """One pass over every waiting job.

    Queues come by priority, jobs in their queue's order; each is offered what is free of its queue's pools. The first one
    that has to wait for room becomes the head of the hosts that it could use: it reserves the place and the time at which
    it will start, and what follows may start only where that is not delayed. Equal snapshots give equal decisions.
    """
    return _Pass(snapshot).run()


class _Pass:
    """The state of one pass."""

    def __init__(self, snapshot: Snapshot) -> None:
        self.snapshot, self.now = snapshot, snapshot.now
        self.room = Room.of(snapshot)
        self.lanes: dict[object, Lane] = {}
        self.lines: dict[str, Line] = {}
        self.heads: list[Head] = []
        self.ending = {gang.job for gang in snapshot.running if gang.ending}
        self.holders: list[Holder] = []
        """Gangs that this pass starts."""
        self.starts: list[Start] = []
        self.preempts: list[Preempt] = []
        self.cancels: list[Cancel] = []
        self.leading: dict[str, Leading] = {}

    def run(self) -> Decisions:
        jobs: defaultdict[str, list[Waiting]] = defaultdict(list)
        for job in self.snapshot.waiting:
            jobs[job.queue].append(job)
        queues = self.snapshot.queues
        for name in sorted(jobs.keys() & queues.keys(), key=lambda name: (-queues[name].priority, name)):
            self._serve(queues[name], jobs[name])
        for name in sorted(jobs.keys() - queues.keys()):
            self.lines[name] = Line(dispatch_order(None, jobs[name], {}), None)
        board = Board(self.now, self.lines, self.heads, self.room, self.preempts, self.snapshot.drift)
        return Decisions(tuple(self.starts), tuple(self.preempts), tuple(self.cancels), board, self.leading)

    def _serve(self, queue: Queue, jobs: list[Waiting]) -> None:
        """Offer what is free to the jobs of one queue, in their order."""
        ordered = dispatch_order(queue, jobs, self.snapshot.usage)
        lane = self._lane(queue, jobs)
        gone: set[str] = set()
        first = True  # of those that do not start
        for job in ordered if lane.pools else ():
            end = inf if job.timeout is None else end_of(self.now, self.now, job.timeout)
            span = lane.span(end) if lane.times else inf
            if job.shape in lane.failed[span] and not first:
                continue
            if seat := lane.seat(job.shape, end):
                self._start(lane, job, seat, end)
                gone.add(job.job)
                continue
            if first and self._cancelled(queue, lane, job):
                gone.add(job.job)
            else:
                lane.failed[span].add(job.shape)
                self._hold(queue, lane, job, ordered)
            first = False
        self.lines[queue.name] = Line([job for job in ordered if job.job not in gone] if gone else ordered, lane)

    def _lane(self, queue: Queue, jobs: Sequence[Waiting]) -> Lane:
        """Queues without a quota share the lane of their pools."""
        quota = quota_of(queue, jobs, self.snapshot.running, self.snapshot.usage)
        known = (self.snapshot.pools.get(name) for name in queue.pools)
        pools = [pool for pool in known if pool is not None and pool.enabled]
        key: object = tuple(pool.name for pool in pools) if quota is None else queue.name
        if key not in self.lanes:
            self.lanes[key] = Lane(pools, self.room, quota, self.heads)
        return self.lanes[key]

    def _start(self, lane: Lane, job: Waiting, seat: Seat, end: float) -> None:
        self.starts.append(Start(job.job, seat.pool, seat.placements))
        self.holders.append(Holder(end, self.now, job.job, job.name, seat.pool, seat.placements))
        self.room.take(seat)
        for head in self.heads:
            if head.spare.binds(end):
                head.spare.take(seat, self.room)
        if lane.quota is not None:
            lane.quota.take(seat.pool, seat.placements)

    def _cancelled(self, queue: Queue, lane: Lane, job: Waiting) -> bool:
        """Whether one of the queue's time limits ends the job, which is the first in its queue that does not start.

        Only the time at the head counts (AWS's API model): jobs behind it are stuck for another's sake.
        """
        code = (lane.impossible(job.shape) or NO_ROOM).partition(" - ")[0]
        before = self.snapshot.leading.get(queue.name)
        since = before.since if before and (before.job, before.reason) == (job.job, code) else self.now
        self.leading[queue.name] = Leading(job.job, code, since)
        for limit in queue.limits:
            if limit.reason == code and self.now - since > limit.seconds * 1000:
                reason = f"Canceled by JobStateTimeLimit action due to reason: {code}"
                self.cancels.append(Cancel(job.job, reason))
                return True
        return False

    def _hold(self, queue: Queue, lane: Lane, job: Waiting, ordered: Sequence[Waiting]) -> None:
        """The job does not start: make it the head of the hosts that it could use and that nobody before it waits for."""
        pools = tuple(
            pool
            for pool in lane.open(job.shape)
            if not any(host in head.hosts for head in lane.heads for host in self.room.members[pool])
        )
        if not pools:
            return
        used = turn(queue, ordered, job, self.snapshot.usage)
        for victim in victims(job, used, pools, self.room, self.snapshot, self.ending):
            self.ending.add(victim.job)
            self.preempts.append(Preempt(victim.job, job.job))
        held = [holder_of(gang, self.now, gang.job in self.ending) for gang in self.snapshot.running]
        if head := reserve(job, pools, self.room, [*held, *self.holders]):
            self.heads.append(head)
            for each in self.lanes.values():
                each.add(head)
