"""The job that waits for room first: when and where it will start, and whom it preempts to start sooner."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from math import inf
from typing import NamedTuple

from orchestrator.engines.base import Placement
from orchestrator.scheduling.order import score
from orchestrator.scheduling.placement import less
from orchestrator.scheduling.room import Room, Seat, Spare
from orchestrator.scheduling.snapshot import Running, Shape, Snapshot, Waiting

_FOREVER = 4_000_000_000_000
"""An end beyond this (the year 2096) [ms] counts as unknown."""


class Holder(NamedTuple):
    """A gang that holds resources, and when it lets go of them. Holders sort by when they end, the unknown last and oldest
    first: an order that stays the same from one pass to the next."""

    end: float
    """At the latest [ms]; infinite where nobody knows."""
    since: int
    """When it started [ms]."""
    job: str
    name: str
    pool: str
    placements: tuple[Placement, ...]
    ending: bool = False
    """It is being stopped."""


@dataclass(frozen=True)
class Head:
    """A job that waits for room, and for which hosts are kept from those behind it."""

    job: Waiting
    pools: tuple[str, ...]
    """Those whose hosts it is the head of."""
    hosts: frozenset[str]
    """Those, and all that are one machine with one of them."""
    seat: Seat
    """Where it could start at ``spare.at``, with its smallest number of nodes."""
    spare: Spare
    awaits: tuple[Holder, ...]
    """The gangs in its way there, in the order in which they end."""


def end_of(now: int, started_at: int | None, timeout: int | None) -> float:
    """When a gang ends at the latest [ms]; one that is still starting, as if it ran from now on."""
    if timeout is None:
        return inf
    end = max(now, (now if started_at is None else started_at) + timeout * 1000)
    return end if end < _FOREVER else inf


def holder_of(gang: Running, now: int, ending: bool) -> Holder:
    end = now if ending else end_of(now, gang.started_at, gang.timeout)
    since = now if gang.started_at is None else gang.started_at
    return Holder(end, since, gang.job, gang.name, gang.pool, gang.placements, ending)


def reserve(job: Waiting, pools: tuple[str, ...], room: Room, holders: Iterable[Holder]) -> Head | None:
    """The earliest time, going by the ends that are known, at which the job fits into one of the pools.

    Args:
        job: It does not fit now.
        pools: Where it would fit if nothing ran.
        room: What is free now; not changed.
        holders: Every gang that holds resources.
    """
    hosts = room.reach(pools)
    ends = sorted(each for each in holders if each.pool in pools or any(p.host in hosts for p in each.placements))
    count = _fewest(job.shape, pools, room, [(each.pool, each.placements) for each in ends])
    at = ends[count - 1].end if count else inf
    while count < len(ends) and ends[count].end == at < inf:  # whoever ends at the same time leaves room to others
        count += 1
    then = room.copy()
    for each in ends[:count]:
        then.release(each.pool, each.placements)
    seat = _seat(job.shape, pools, then)
    if seat is None:
        return None
    chosen: defaultdict[str, list[Placement]] = defaultdict(list)
    for placement in seat.placements:
        for name in room.beside(placement.host):
            chosen[name].append(placement)
    left = {name: less(then.hosts[name], taken) for name, taken in chosen.items()}
    spare = Spare(at, seat.pool, left, then.cpus[seat.pool] - sum(placement.cpus for placement in seat.placements))
    awaits = tuple(
        each
        for each in ends[:count]
        if any(p.host in chosen for p in each.placements) or (each.pool == seat.pool and spare.cpus < inf)
    )
    return Head(job, pools, hosts, seat, spare, awaits)


def victims(
    job: Waiting, turn: float, pools: tuple[str, ...], room: Room, snapshot: Snapshot, ending: set[str]
) -> list[Running]:
    """Whom to preempt so that the job can start: none more than needed, and none at all where that would not be enough.

    Of those that may be preempted the least important go first: lowest queue priority, lowest job priority, youngest.

    Args:
        job: A head.
        turn: What its share has used when its turn comes (:func:`orchestrator.scheduling.order.turn`).
        pools: Where it would fit if nothing ran.
        room: What is free now; not changed.
        snapshot: The pass.
        ending: Jobs that are being stopped: what they hold counts as coming free.
    """
    hosts = room.reach(pools)
    near = [gang for gang in snapshot.running if gang.pool in pools or any(p.host in hosts for p in gang.placements)]
    coming = room.copy()
    for gang in near:
        if gang.job in ending:
            coming.release(gang.pool, gang.placements)
    candidates = [gang for gang in near if gang.job not in ending and _may_preempt(job, turn, gang, snapshot)]
    candidates.sort(key=lambda gang: _importance(gang, snapshot))
    count = _fewest(job.shape, pools, coming, [(gang.pool, gang.placements) for gang in candidates])
    chosen = candidates[:count]
    if not _fits_after(chosen, job.shape, pools, coming):
        return []
    for gang in reversed(chosen):  # the most important first: it is the first to be spared
        others = [each for each in chosen if each is not gang]
        if _fits_after(others, job.shape, pools, coming):
            chosen = others
    return chosen


def _may_preempt(job: Waiting, turn: float, gang: Running, snapshot: Snapshot) -> bool:
    """Whether the job is more important than the gang and, once the gang waits again, is served before it.

    Without the second condition the gang would take back what it gave up, and so on for ever: in a queue that is first in,
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
    return share == other or (turn, share) < (score(mine, other, snapshot.usage), other)


def _importance(gang: Running, snapshot: Snapshot) -> tuple[int, int, float, str]:
    youth = -inf if gang.started_at is None else -gang.started_at
    return snapshot.queues[gang.queue].priority, gang.priority, youth, gang.job


def _fits_after(gangs: Sequence[Running], shape: Shape, pools: tuple[str, ...], room: Room) -> bool:
    then = room.copy()
    for gang in gangs:
        then.release(gang.pool, gang.placements)
    return _seat(shape, pools, then) is not None


def _fewest(shape: Shape, pools: tuple[str, ...], room: Room, ends: Sequence[tuple[str, tuple[Placement, ...]]]) -> int:
    """How many of the gangs (pool and placements, in the order in which they end) have to end until the shape fits.

    By bisection; all of them where the shape fits at no time before.
    """
    low, high, after_low = 0, len(ends), room
    while high - low > 1:
        middle = (low + high) // 2
        then = after_low.copy()
        for pool, placements in ends[low:middle]:
            then.release(pool, placements)
        if _seat(shape, pools, then):
            high = middle
        else:
            low, after_low = middle, then
    return high


def _seat(shape: Shape, pools: tuple[str, ...], room: Room) -> Seat | None:
    """A place for as few nodes as the gang may start with."""
    return next((seat for pool in pools if (seat := room.seat(shape, pool, most=shape.minimum))), None)
