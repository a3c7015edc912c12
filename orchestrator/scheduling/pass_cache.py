"""A cache for one pass: queues with the same compute environments share results, so a shape that did not fit once is not tried again."""

from __future__ import annotations

from bisect import bisect_left, insort
from collections import defaultdict
from collections.abc import Sequence
from math import inf

from orchestrator.domain.gang import Shape
from orchestrator.domain.reasons import Reason
from orchestrator.scheduling.fit import examine
from orchestrator.scheduling.free_resources import Allocation, FreeResources
from orchestrator.scheduling.placement import affordable, count_of, needs
from orchestrator.scheduling.quota import Quota
from orchestrator.scheduling.reservation import Reservation
from orchestrator.scheduling.snapshot import ComputeEnvironment
from shared_store.contract.error_text import counted

NO_ROOM = "CAPACITY:INSUFFICIENT_INSTANCE_CAPACITY"


class PassCache:
    """The enabled compute environments of a queue, or of several queues with the same ones."""

    def __init__(
        self,
        ces: Sequence[ComputeEnvironment],
        free: FreeResources,
        quota: Quota | None,
        reservations: Sequence[Reservation],
    ) -> None:
        """``free`` shrinks as gangs start."""
        self.compute_environments, self.free, self.quota = {ce.name: ce for ce in ces}, free, quota
        self.hosts = frozenset(host for name in self.compute_environments for host in free.members[name])
        self.reservations: list[Reservation] = []
        """Those on hosts of these compute environments, in the order in which they were made."""
        self.times: list[float] = []
        """Their known start times [ms], sorted."""
        self.failed: defaultdict[float, set[Shape]] = defaultdict(set)
        """Shapes that can't start any more in this pass, by their running time (see :meth:`span`)."""
        self._possible: dict[Shape, tuple[str, ...]] = {}
        self._impossible: dict[Shape, Reason] = {}
        for reservation in reservations:
            self.add(reservation)

    def add(self, reservation: Reservation) -> None:
        """From now on the reservation's hosts are kept for its job."""
        if reservation.hosts & self.hosts:
            self.reservations.append(reservation)
            if reservation.window.at < inf:
                insort(self.times, reservation.window.at)

    def span(self, end: float) -> float:
        """The first start of a reservation that an end [ms] comes before; infinite where it comes before none.

        Of two equal gangs with the same span either both have to make way for a reservation or neither.
        """
        index = bisect_left(self.times, end)
        return self.times[index] if index < len(self.times) else inf

    def possible(self, shape: Shape) -> tuple[str, ...]:
        """The compute environments into which the shape would fit if nothing ran."""
        if shape not in self._possible:
            self._examine(shape)
        return self._possible[shape]

    def impossible(self, shape: Shape) -> Reason | None:
        """Why the shape fits into no compute environment, even an empty one."""
        return None if self.possible(shape) else self._impossible[shape]

    def allocation(self, shape: Shape, end: float) -> Allocation | None:
        """A place for a gang that starts now and ends at ``end`` [ms] at the latest."""
        bounds = [reservation.window for reservation in self.reservations if reservation.window.binds(end)]
        for ce in self.possible(shape):
            most = self._within_quota(shape, ce)
            if most and (allocation := self.free.allocation(shape, ce, bounds, most)):
                return allocation
        return None

    def open(self, shape: Shape) -> tuple[str, ...]:
        """The compute environments into which the shape would fit and which the quota leaves open to it now."""
        return tuple(ce for ce in self.possible(shape) if self._within_quota(shape, ce))

    def _within_quota(self, shape: Shape, ce: str) -> int:
        """The number of nodes with which the gang stays within the queue's quota in the compute environment; 0 if it can't start."""
        if self.quota is None:
            return len(shape.nodes)
        left = self.quota.left(shape, ce, self.free.totals(ce), self._max_cpus(ce))
        return affordable(shape, gpus=left) if shape.uses_gpus else affordable(shape, cpus=left)

    def _max_cpus(self, ce: str) -> float:
        most = self.compute_environments[ce].max_cpus
        return inf if most is None else most

    def _examine(self, shape: Shape) -> None:
        self._possible[shape], self._impossible[shape] = examine(
            shape, list(self.compute_environments.values()), self.free
        )

    def barred(self, shape: Shape) -> Reason | None:
        """Why the queue's quota excludes the shape from every compute environment into which it would fit."""
        if self.quota is None or self.open(shape):
            return None
        what = "GPU" if shape.uses_gpus else "CPU"
        parts = []
        for ce in self.possible(shape):
            limit = self.quota.limit(shape.uses_gpus, self.free.totals(ce), self._max_cpus(ce))
            used = self.quota.used_of(ce, shape.uses_gpus)
            parts.append(f"its queue uses {used:g} of the {count_of(limit, what)} that it may use of {ce}")
        shares = f"{counted(self.quota.active, 'active share')}"
        kept = f"{100 * self.quota.kept:.3g}% is kept for shares that are not active ({shares} now)"
        return Reason.coded(NO_ROOM, f"{'; '.join(parts)}: {kept}; {needs(shape)}")
