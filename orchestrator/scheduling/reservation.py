"""Backfill reservations: when and where the first job that has to wait will start, and which jobs it preempts to start sooner."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from math import inf
from typing import NamedTuple

from orchestrator.domain.gang import Shape
from orchestrator.domain.hosts import Placement
from orchestrator.scheduling.free_resources import Allocation, BackfillWindow, FreeResources
from orchestrator.scheduling.order import score
from orchestrator.scheduling.placement import less
from orchestrator.scheduling.snapshot import RunningGang, Snapshot, Waiting

_FOREVER = 4_000_000_000_000
"""An end beyond this (the year 2096) [ms] counts as unknown."""


class Holder(NamedTuple):
    """A gang that holds resources, and when it releases them. Holders sort by when they end, the unknown last and oldest
    first: an order that stays the same from one pass to the next."""

    end: float
    """At the latest [ms]; infinite if unknown."""
    since: int
    """When it started [ms]."""
    job: str
    name: str
    compute_environment: str
    placements: tuple[Placement, ...]
    ending: bool = False
    """It is being stopped."""


@dataclass(frozen=True)
class Reservation:
    """A waiting job, and the hosts reserved for it."""

    job: Waiting
    compute_environments: tuple[str, ...]
    """Those whose hosts it reserves."""
    hosts: frozenset[str]
    """Those hosts, and all on the same machines."""
    allocation: Allocation
    """Hosts on which it could start at ``window.at``, with its smallest number of nodes."""
    window: BackfillWindow
    awaits: tuple[Holder, ...]
    """The gangs that occupy it, in the order of their ends."""


def end_of(now: int, started_at: int | None, timeout: int | None) -> float:
    """The latest end of a gang [ms]; a gang that is still starting counts as started now."""
    if timeout is None:
        return inf
    end = max(now, (now if started_at is None else started_at) + timeout * 1000)
    return end if end < _FOREVER else inf


def holder_of(gang: RunningGang, now: int, ending: bool) -> Holder:
    end = now if ending else end_of(now, gang.started_at, gang.timeout)
    since = now if gang.started_at is None else gang.started_at
    return Holder(end, since, gang.job, gang.name, gang.compute_environment, gang.placements, ending)


def reserve(job: Waiting, ces: tuple[str, ...], free: FreeResources, holders: Iterable[Holder]) -> Reservation | None:
    """The earliest time, by the known ends, at which the job fits into one of the compute environments.

    Args:
        job: It does not fit now.
        ces: The compute environments in which it would fit if nothing ran.
        free: The free resources now; not changed.
        holders: Every gang that holds resources.
    """
    hosts = free.reach(ces)
    near = (
        each for each in holders if each.compute_environment in ces or any(p.host in hosts for p in each.placements)
    )
    # what is being stopped before what is overdue: a job gets the room of the gangs that were stopped for it, and no other
    ends = sorted(near, key=lambda each: (each.end, not each.ending, each))
    count = _fewest(job.shape, ces, free, [(each.compute_environment, each.placements) for each in ends])
    at = ends[count - 1].end if count else inf
    while count < len(ends) and ends[count].end == at < inf and ends[count].ending == ends[count - 1].ending:
        # gangs that end at the same time make room for others
        count += 1
    then = free.copy()
    for each in ends[:count]:
        then.release(each.compute_environment, each.placements)
    allocation = _allocation(job.shape, ces, then)
    if allocation is None:
        return None
    chosen: defaultdict[str, list[Placement]] = defaultdict(list)
    for placement in allocation.placements:
        for name in free.beside(placement.host):
            chosen[name].append(placement)
    left = {name: less(then.hosts[name], taken) for name, taken in chosen.items()}
    window = BackfillWindow(
        at,
        allocation.compute_environment,
        left,
        then.cpus[allocation.compute_environment] - sum(placement.cpus for placement in allocation.placements),
    )
    awaits = tuple(
        each
        for each in ends[:count]
        if any(p.host in chosen for p in each.placements)
        or (each.compute_environment == allocation.compute_environment and window.cpus < inf)
    )
    return Reservation(job, ces, hosts, allocation, window, awaits)


def victims(
    job: Waiting, share_score: float, ces: tuple[str, ...], free: FreeResources, snapshot: Snapshot, ending: set[str]
) -> list[RunningGang]:
    """Gangs to preempt so that the job can start: no more than needed, and none if that would not suffice.

    Of those that may be preempted the least important go first: lowest queue priority, lowest job priority, youngest.

    Args:
        job: A job with a reservation, or about to get one.
        share_score: The usage of its share when its turn comes (:func:`orchestrator.scheduling.order.share_score`).
        ces: The compute environments in which it would fit if nothing ran.
        free: The free resources now; not changed.
        snapshot: The pass.
        ending: Jobs that are being stopped: what they hold counts as coming free.
    """
    hosts = free.reach(ces)
    near = [
        gang
        for gang in snapshot.running
        if gang.compute_environment in ces or any(p.host in hosts for p in gang.placements)
    ]
    coming = free.copy()
    for gang in near:
        if gang.job in ending:
            coming.release(gang.compute_environment, gang.placements)
    candidates = [gang for gang in near if gang.job not in ending and _may_preempt(job, share_score, gang, snapshot)]
    candidates.sort(key=lambda gang: _importance(gang, snapshot))
    count = _fewest(job.shape, ces, coming, [(gang.compute_environment, gang.placements) for gang in candidates])
    chosen = candidates[:count]
    if not _fits_after(chosen, job.shape, ces, coming):
        return []
    for gang in reversed(chosen):  # the most important first: it is spared first
        others = [each for each in chosen if each is not gang]
        if _fits_after(others, job.shape, ces, coming):
            chosen = others
    return chosen


def _may_preempt(job: Waiting, share_score: float, gang: RunningGang, snapshot: Snapshot) -> bool:
    """Whether the job is more important than the gang and, once the gang waits again, is served before it.

    Without the second condition the gang would preempt the job in turn, and so on: in a queue that is first in,
    first out priorities count for nothing, and between the shares of a policy only use does.
    """
    mine, its = snapshot.queues.get(job.queue), snapshot.queues.get(gang.queue)
    if not gang.preemptible or mine is None or its is None:
        return False
    if mine is not its:
        return mine.priority > its.priority
    if mine.policy is None or job.priority <= gang.priority:
        return False
    share, other = job.share or "", gang.share or ""
    return share == other or (share_score, share) < (score(mine, other, snapshot.usage), other)


def _importance(gang: RunningGang, snapshot: Snapshot) -> tuple[int, int, float, str]:
    youth = -inf if gang.started_at is None else -gang.started_at
    return snapshot.queues[gang.queue].priority, gang.priority, youth, gang.job


def _fits_after(gangs: Sequence[RunningGang], shape: Shape, ces: tuple[str, ...], free: FreeResources) -> bool:
    then = free.copy()
    for gang in gangs:
        then.release(gang.compute_environment, gang.placements)
    return _allocation(shape, ces, then) is not None


def _fewest(
    shape: Shape, ces: tuple[str, ...], free: FreeResources, ends: Sequence[tuple[str, tuple[Placement, ...]]]
) -> int:
    """Number of gangs (compute environment and placements, in the order in which they end) that have to end until the shape fits.

    By bisection; all of them where the shape fits at no time before.
    """
    low, high, after_low = 0, len(ends), free
    while high - low > 1:
        middle = (low + high) // 2
        then = after_low.copy()
        for ce, placements in ends[low:middle]:
            then.release(ce, placements)
        if _allocation(shape, ces, then):
            high = middle
        else:
            low, after_low = middle, then
    return high


def _allocation(shape: Shape, ces: tuple[str, ...], free: FreeResources) -> Allocation | None:
    """A place for as few nodes as the gang may start with."""
    return next((allocation for ce in ces if (allocation := free.allocation(shape, ce, most=shape.minimum))), None)
