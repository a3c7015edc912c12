"""What the jobs of queues with the same pools have in common in one pass; what failed once there fails again."""

from __future__ import annotations

from bisect import bisect_left, insort
from collections import defaultdict
from collections.abc import Sequence
from math import inf

from orchestrator.scheduling.fit import examine
from orchestrator.scheduling.head import Head
from orchestrator.scheduling.placement import affordable, count_of, needs
from orchestrator.scheduling.quota import Quota
from orchestrator.scheduling.room import Room, Seat
from orchestrator.scheduling.snapshot import Pool, Shape
from shared_store.wording import counted

NO_ROOM = "CAPACITY:INSUFFICIENT_INSTANCE_CAPACITY"


class Lane:
    """The enabled pools of a queue, or of several queues with the same ones."""

    def __init__(self, pools: Sequence[Pool], room: Room, quota: Quota | None, heads: Sequence[Head]) -> None:
        """``room`` shrinks as gangs start."""
        self.pools, self.room, self.quota = {pool.name: pool for pool in pools}, room, quota
        self.hosts = frozenset(host for name in self.pools for host in room.members[name])
        self.heads: list[Head] = []
        """Those that keep hosts of this lane, in the order in which they came."""
        self.times: list[float] = []
        """When they start, where that is known [ms], sorted."""
        self.failed: defaultdict[float, set[Shape]] = defaultdict(set)
        """Shapes that can't start any more in this pass, by how long they would run (see :meth:`span`)."""
        self._possible: dict[Shape, tuple[str, ...]] = {}
        self._impossible: dict[Shape, str] = {}
        for head in heads:
            self.add(head)

    def add(self, head: Head) -> None:
        """From now on the head's hosts are kept for it."""
        if head.hosts & self.hosts:
            self.heads.append(head)
            if head.spare.at < inf:
                insort(self.times, head.spare.at)

    def span(self, end: float) -> float:
        """The first start of a head that an end [ms] comes before; infinite where it comes before none.

        Of two equal gangs with the same span either both have to make way for a head or neither.
        """
        index = bisect_left(self.times, end)
        return self.times[index] if index < len(self.times) else inf

    def possible(self, shape: Shape) -> tuple[str, ...]:
        """The pools into which the shape would fit if nothing ran."""
        if shape not in self._possible:
            self._examine(shape)
        return self._possible[shape]

    def impossible(self, shape: Shape) -> str | None:
        """Why the shape fits into no pool, even an empty one: a reason with its code."""
        return None if self.possible(shape) else self._impossible[shape]

    def seat(self, shape: Shape, end: float) -> Seat | None:
        """A place for a gang that starts now and ends at ``end`` [ms] at the latest."""
        bounds = [head.spare for head in self.heads if head.spare.binds(end)]
        for pool in self.possible(shape):
            most = self._within_quota(shape, pool)
            if most and (seat := self.room.seat(shape, pool, bounds, most)):
                return seat
        return None

    def open(self, shape: Shape) -> tuple[str, ...]:
        """The pools that the shape would fit into and that the quota does not keep it out of now."""
        return tuple(pool for pool in self.possible(shape) if self._within_quota(shape, pool))

    def _within_quota(self, shape: Shape, pool: str) -> int:
        """With how many nodes the gang stays within the queue's quota in the pool; 0 where it can't start."""
        if self.quota is None:
            return len(shape.nodes)
        left = self.quota.left(shape, pool, self.room.totals(pool), self._max_cpus(pool))
        return affordable(shape, gpus=left) if shape.uses_gpus else affordable(shape, cpus=left)

    def _max_cpus(self, pool: str) -> float:
        most = self.pools[pool].max_cpus
        return inf if most is None else most

    def _examine(self, shape: Shape) -> None:
        self._possible[shape], self._impossible[shape] = examine(shape, list(self.pools.values()), self.room)

    def barred(self, shape: Shape) -> str | None:
        """Why the queue's quota keeps the shape out of every pool that it would fit into: a reason with its code."""
        if self.quota is None or self.open(shape):
            return None
        what = "GPU" if shape.uses_gpus else "CPU"
        parts = []
        for pool in self.possible(shape):
            limit = self.quota.limit(shape.uses_gpus, self.room.totals(pool), self._max_cpus(pool))
            used = self.quota.used_of(pool, shape.uses_gpus)
            parts.append(f"its queue uses {used:g} of the {count_of(limit, what)} that it may use of {pool}")
        shares = f"{counted(self.quota.active, 'active share')}"
        kept = f"{100 * self.quota.kept:.3g}% is kept for shares that are not active ({shares} now)"
        return f"{NO_ROOM} - {needs(shape)}; {'; '.join(parts)}: {kept}"
