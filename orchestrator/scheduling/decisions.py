"""The decisions of one scheduling pass: which jobs start and where, which are preempted or cancelled, and why the others wait."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain, groupby
from math import inf
from operator import attrgetter

from orchestrator.domain.hosts import Placement
from orchestrator.scheduling.free_resources import Allocation, FreeResources
from orchestrator.scheduling.order import dispatch_order, head_of, in_turns, share_score, turn
from orchestrator.scheduling.pass_cache import NO_ROOM, PassCache
from orchestrator.scheduling.quota import quota_of
from orchestrator.scheduling.reasons import QueueOrder, WaitReport
from orchestrator.scheduling.reservation import Holder, Reservation, end_of, holder_of, reserve, victims
from orchestrator.scheduling.snapshot import Leading, Moment, Queue, QueueHead, RoundRobin, Snapshot, Waiting


@dataclass(frozen=True, slots=True)
class Start:
    """Launch the job's gang in this compute environment, with one placement per node, by index."""

    job: str
    compute_environment: str
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
    """The controller's next actions; the report has the reasons of the jobs that wait."""

    starts: tuple[Start, ...]
    preempts: tuple[Preempt, ...]
    cancels: tuple[Cancel, ...]
    report: WaitReport
    leading: Mapping[str, Leading]
    """By queue; for the next snapshot."""
    turns: RoundRobin
    """For the next snapshot."""


def decide(snapshot: Snapshot) -> Decisions:
    """One pass over every waiting job.

    Queues come by priority, and take turns where that is equal; jobs come in their queue's order. Each is offered what is free of its
    queue's compute environments. The first one that has to wait gets a reservation on the hosts that it could use: of the place and the
    time at which it will start, and what follows may start only where that is not delayed. Equal snapshots give equal decisions.
    """
    return _Pass(snapshot).run()


@dataclass
class _Line:
    """The waiting jobs of one queue."""

    queue: Queue
    jobs: Sequence[Waiting]
    """In their order."""
    cache: PassCache
    gone: set[str] = field(default_factory=set)
    first: bool = True
    """Whether none of them has had to wait in this pass."""

    def each(self) -> Iterator[tuple[_Line, Waiting]]:
        return ((self, job) for job in self.jobs)


class _Pass:
    """The state of one pass."""

    def __init__(self, snapshot: Snapshot) -> None:
        self.snapshot, self.now = snapshot, snapshot.now
        self.free = FreeResources.of(snapshot)
        self.caches: dict[object, PassCache] = {}
        self.orders: dict[str, QueueOrder] = {}
        self.reservations: list[Reservation] = []
        self.ending = {gang.job for gang in snapshot.running if gang.ending}
        self.holders: list[Holder] = []
        """Gangs that this pass starts."""
        self.starts: list[Start] = []
        self.preempts: list[Preempt] = []
        self.cancels: list[Cancel] = []
        self.leading: dict[str, Leading] = {}
        self.served, self.heads = dict(snapshot.turns.served), dict[str, QueueHead]()

    def run(self) -> Decisions:
        jobs: defaultdict[str, list[Waiting]] = defaultdict(list)
        for job in self.snapshot.waiting:
            jobs[job.queue].append(job)
        queues = self.snapshot.queues
        names = sorted(jobs.keys() & queues.keys(), key=lambda name: (-queues[name].priority, name))
        for _, equal in groupby(names, key=lambda name: queues[name].priority):
            self._serve([self._line(queues[name], jobs[name]) for name in equal])
        for name in jobs.keys() - queues.keys():
            self.orders[name] = QueueOrder(dispatch_order(None, jobs[name], {}, RoundRobin(), bool), None)
        preempted = {each.job for each in self.preempts}
        report = WaitReport(self.now, self.orders, self.reservations, self.free, preempted, self.snapshot.drift)
        return Decisions(
            tuple(self.starts),
            tuple(self.preempts),
            tuple(self.cancels),
            report,
            self.leading,
            RoundRobin({key: at for key, at in self.served.items() if key[0] in queues}, self.heads),
        )

    def _line(self, queue: Queue, jobs: Sequence[Waiting]) -> _Line:
        cache, snapshot = self._cache(queue, jobs), self.snapshot
        ordered = dispatch_order(
            queue, jobs, snapshot.usage, snapshot.turns, lambda job: bool(cache.possible(job.shape))
        )
        return _Line(queue, ordered, cache)

    def _serve(self, lines: Sequence[_Line]) -> None:
        """Offer the free resources to the jobs of queues of one priority."""
        for line, job in self._in_turns([line for line in lines if line.cache.compute_environments]):
            end = inf if job.timeout is None else end_of(self.now, self.now, job.timeout)
            cache = line.cache
            span = cache.span(end) if cache.times else inf
            if job.shape in cache.failed[span] and not line.first:
                continue
            if allocation := cache.allocation(job.shape, end):
                self._start(cache, job, allocation, end)
                line.gone.add(job.job)
                continue
            if line.first and self._cancelled(line.queue, cache, job):
                line.gone.add(job.job)
            else:
                cache.failed[span].add(job.shape)
                self._hold(line, job)
            line.first = False
        for line in lines:
            left = [job for job in line.jobs if job.job not in line.gone] if line.gone else line.jobs
            self.orders[line.queue.name] = QueueOrder(left, line.cache)

    def _in_turns(self, lines: Sequence[_Line]) -> Iterator[tuple[_Line, Waiting]]:
        """The jobs of all lines: the heads of the last pass as they became heads, then one of each line after the other.

        A head keeps its place: else what passes it would change whose turn it is, and two heads could take each other's room for ever.
        """
        if len(lines) < 2:
            return ((line, job) for line in lines for job in line.jobs)
        turns = self.snapshot.turns
        found = [(line, head_of(line.queue, line.jobs, turns)) for line in lines]
        heads = [(line, head) for line, head in found if head is not None]
        heads.sort(key=lambda each: turns.heads[each[0].queue.name].since)
        served: dict[str, Moment] = {}
        for (name, _), at in turns.served.items():
            served[name] = max(at, served.get(name, at))
        line_up = sorted(
            lines,
            key=lambda line: turn(served.get(line.queue.name), min(line.jobs, key=attrgetter("created_at", "job"))),
        )
        merged = in_turns([line.each() for line in line_up], lambda each: bool(each[0].cache.possible(each[1].shape)))
        taken = {head.job for _, head in heads}
        return chain(heads, (each for each in merged if each[1].job not in taken))

    def _cache(self, queue: Queue, jobs: Sequence[Waiting]) -> PassCache:
        """Queues without a quota share the cache of their compute environments."""
        quota = quota_of(queue, jobs, self.snapshot.running, self.snapshot.usage)
        known = (self.snapshot.compute_environments.get(name) for name in queue.compute_environments)
        ces = [ce for ce in known if ce is not None and ce.enabled]
        key: object = tuple(ce.name for ce in ces) if quota is None else queue.name
        if key not in self.caches:
            self.caches[key] = PassCache(ces, self.free, quota, self.reservations)
        return self.caches[key]

    def _start(self, cache: PassCache, job: Waiting, allocation: Allocation, end: float) -> None:
        self.served[job.queue, job.owner] = self.now, len(self.starts)
        self.starts.append(Start(job.job, allocation.compute_environment, allocation.placements))
        self.holders.append(
            Holder(end, self.now, job.job, job.name, allocation.compute_environment, allocation.placements)
        )
        self.free.take(allocation)
        for reservation in self.reservations:
            if reservation.window.binds(end):
                reservation.window.take(allocation, self.free)
        if cache.quota is not None:
            cache.quota.take(allocation.compute_environment, allocation.placements)

    def _cancelled(self, queue: Queue, cache: PassCache, job: Waiting) -> bool:
        """Whether one of the queue's time limits ends the job, the first in its queue that does not start. Only the time at the head counts
        (AWS's API model): the jobs behind it wait because of another job.
        """
        never = cache.impossible(job.shape)
        code = never.code if never else NO_ROOM
        before = self.snapshot.leading.get(queue.name)
        since = before.since if before and (before.job, before.reason) == (job.job, code) else self.now
        self.leading[queue.name] = Leading(job.job, code, since)
        for limit in queue.limits:
            if limit.reason == code and self.now - since > limit.seconds * 1000:
                reason = f"Canceled by JobStateTimeLimit action due to reason: {code}"
                self.cancels.append(Cancel(job.job, reason))
                return True
        return False

    def _hold(self, line: _Line, job: Waiting) -> None:
        """The job does not start: reserve hosts that it could use and that no earlier job has reserved."""
        queue, possible = line.queue, line.cache.open(job.shape)
        if possible and queue.name not in self.heads:
            before = self.snapshot.turns.heads.get(queue.name)
            if before is None or before.job != job.job:
                before = QueueHead(job.job, (self.now, len(self.heads)))
            self.heads[queue.name] = before
        ces = tuple(
            ce
            for ce in possible
            if not any(
                host in reservation.hosts for reservation in line.cache.reservations for host in self.free.members[ce]
            )
        )
        if not ces:
            return
        used = share_score(queue, line.jobs, job, self.snapshot.usage)
        for victim in victims(job, used, ces, self.free, self.snapshot, self.ending):
            self.ending.add(victim.job)
            self.preempts.append(Preempt(victim.job, job.job))
        held = [holder_of(gang, self.now, gang.job in self.ending) for gang in self.snapshot.running]
        if reservation := reserve(job, ces, self.free, [*held, *self.holders]):
            self.reservations.append(reservation)
            for each in self.caches.values():
                each.add(reservation)
