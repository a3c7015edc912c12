"""One scheduling pass: which jobs start and where, which are preempted or cancelled, and why the others wait."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import inf

from orchestrator.domain.hosts import Placement
from orchestrator.scheduling.free_resources import Allocation, FreeResources
from orchestrator.scheduling.order import dispatch_order, share_score
from orchestrator.scheduling.pass_cache import NO_ROOM, PassCache
from orchestrator.scheduling.quota import quota_of
from orchestrator.scheduling.reasons import QueueOrder, WaitReport
from orchestrator.scheduling.reservation import Holder, Reservation, end_of, holder_of, reserve, victims
from orchestrator.scheduling.snapshot import Leading, Queue, Snapshot, Waiting


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


def decide(snapshot: Snapshot) -> Decisions:
    """One pass over every waiting job.

    Queues come by priority, jobs in their queue's order; each is offered what is free of its queue's compute environments. The first one
    that has to wait gets a reservation on the hosts that it could use: of the place and the time at which
    it will start, and what follows may start only where that is not delayed. Equal snapshots give equal decisions.
    """
    return _Pass(snapshot).run()


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

    def run(self) -> Decisions:
        jobs: defaultdict[str, list[Waiting]] = defaultdict(list)
        for job in self.snapshot.waiting:
            jobs[job.queue].append(job)
        queues = self.snapshot.queues
        for name in sorted(jobs.keys() & queues.keys(), key=lambda name: (-queues[name].priority, name)):
            self._serve(queues[name], jobs[name])
        for name in jobs.keys() - queues.keys():
            self.orders[name] = QueueOrder(dispatch_order(None, jobs[name], {}), None)
        report = WaitReport(self.now, self.orders, self.reservations, self.free, self.preempts, self.snapshot.drift)
        return Decisions(tuple(self.starts), tuple(self.preempts), tuple(self.cancels), report, self.leading)

    def _serve(self, queue: Queue, jobs: list[Waiting]) -> None:
        """Offer the free resources to the jobs of one queue, in their order."""
        ordered = dispatch_order(queue, jobs, self.snapshot.usage)
        cache = self._cache(queue, jobs)
        gone: set[str] = set()
        first = True  # of those that do not start
        for job in ordered if cache.compute_environments else ():
            end = inf if job.timeout is None else end_of(self.now, self.now, job.timeout)
            span = cache.span(end) if cache.times else inf
            if job.shape in cache.failed[span] and not first:
                continue
            if allocation := cache.allocation(job.shape, end):
                self._start(cache, job, allocation, end)
                gone.add(job.job)
                continue
            if first and self._cancelled(queue, cache, job):
                gone.add(job.job)
            else:
                cache.failed[span].add(job.shape)
                self._hold(queue, cache, job, ordered)
            first = False
        self.orders[queue.name] = QueueOrder(
            [job for job in ordered if job.job not in gone] if gone else ordered, cache
        )

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

    def _hold(self, queue: Queue, cache: PassCache, job: Waiting, ordered: Sequence[Waiting]) -> None:
        """The job does not start: reserve hosts that it could use and that no earlier job has reserved."""
        ces = tuple(
            ce
            for ce in cache.open(job.shape)
            if not any(
                host in reservation.hosts for reservation in cache.reservations for host in self.free.members[ce]
            )
        )
        if not ces:
            return
        used = share_score(queue, ordered, job, self.snapshot.usage)
        for victim in victims(job, used, ces, self.free, self.snapshot, self.ending):
            self.ending.add(victim.job)
            self.preempts.append(Preempt(victim.job, job.job))
        held = [holder_of(gang, self.now, gang.job in self.ending) for gang in self.snapshot.running]
        if reservation := reserve(job, ces, self.free, [*held, *self.holders]):
            self.reservations.append(reservation)
            for each in self.caches.values():
                each.add(reservation)
