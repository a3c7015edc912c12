"""The reasons why jobs wait, in words that a user can act on; worded only for jobs that are asked about."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cached_property
from math import inf

from orchestrator.domain.gang import Shape
from orchestrator.domain.reasons import Reason, named
from orchestrator.domain.resources import EPSILON, Resources
from orchestrator.scheduling.free_resources import FreeResources
from orchestrator.scheduling.pass_cache import NO_ROOM, PassCache
from orchestrator.scheduling.placement import count_of, limit_of, needs, shortage, together
from orchestrator.scheduling.reservation import Reservation
from orchestrator.scheduling.snapshot import Waiting
from shared_store.contract.error_text import enumerated

NO_COMPUTE_ENVIRONMENT = Reason(
    "no compute environment of its queue is enabled",
    "ACTION_REQUIRED - CE(s) associated with the job queue are invalid.",
)
_NAMED = 3
"""Greatest number of jobs that a reason names."""


@dataclass(frozen=True)
class QueueOrder:
    """The jobs of one queue that wait, in their order."""

    jobs: Sequence[Waiting]
    cache: PassCache | None
    """None: there is no such queue."""


class WaitReport:
    """The result of a pass: each queue's order, and each waiting job's reason. Decided once, worded on request."""

    def __init__(
        self,
        now: int,
        orders: Mapping[str, QueueOrder],
        reservations: Sequence[Reservation],
        free: FreeResources,
        preempted: Collection[str],
        drift: int,
    ) -> None:
        """Args:
        now: Time of the pass [ms].
        orders: By queue.
        reservations: In the order in which they came.
        free: The free resources after the pass.
        preempted: The preempted jobs.
        drift: Difference of Unix time to the pass's clock [ms].
        """
        self._now, self._queues, self._resources, self._preempted, self._drift = now, orders, free, preempted, drift
        self._reservations = {reservation.job.job: reservation for reservation in reservations}
        self._orders: dict[str, tuple[str, ...]] = {}
        self._common: dict[tuple[str, Shape], tuple[bool, Reason]] = {}

    def order(self, queue: str) -> Sequence[str]:
        """Ids of the queue's waiting jobs in the order of service; empty if none waits."""
        if queue not in self._orders:
            queue_order = self._queues.get(queue)
            self._orders[queue] = tuple(job.job for job in queue_order.jobs) if queue_order else ()
        return self._orders[queue]

    def preempts(self, job: str) -> bool:
        """Whether the pass has decided to preempt this job."""
        return job in self._preempted

    def reason(self, job: str) -> Reason:
        """Why a job waits. Raises KeyError for one that starts, is cancelled or was not waiting."""
        queue, position = self._positions[job]
        queue_order = self._queues[queue]
        if queue_order.cache is None or not queue_order.cache.compute_environments:
            return NO_COMPUTE_ENVIRONMENT
        if reservation := self._reservations.get(job):
            lack = self._lack(reservation.job.shape, reservation.allocation.compute_environment)
            awaited = self._awaited(reservation)
            return Reason.coded(NO_ROOM, f"waits for {awaited}: {lack}" if awaited else lack)
        key = (queue, queue_order.jobs[position].shape)
        if key not in self._common:
            self._common[key] = self._common_reason(queue, queue_order.cache, key[1])
        behind, reason = self._common[key]
        if not behind:
            return reason
        words = f"{_ordinal(position + 1)} in queue {queue}, {reason.words}"
        # AWS gives a code to the first job of a queue only, the one that is stuck
        return Reason.plain(words) if position else Reason.coded(NO_ROOM, words)

    def _common_reason(self, queue: str, cache: PassCache, shape: Shape) -> tuple[bool, Reason]:
        """The reason shared by all jobs of a shape in a queue, and whether it is another job."""
        if reason := cache.impossible(shape) or cache.barred(shape):
            return False, reason
        unknown = [cache.compute_environments[ce].unknown for ce in cache.possible(shape)]
        if all(unknown):
            return False, Reason.coded(NO_ROOM, f"{unknown[0]}; {needs(shape)}")
        before = self._before(queue, cache, shape)
        if before is None:
            return False, Reason.coded(NO_ROOM, self._lack(shape, cache.possible(shape)[0]))
        wants = f"{needs(before.job.shape)}{self._start(before, ' and starts by ')}"
        name = named(before.job.name, before.job.job)
        return True, Reason.plain(f"behind job {name}, which {wants}{self._hint(shape, cache)}")

    @cached_property
    def _positions(self) -> dict[str, tuple[str, int]]:
        """Queue and place in its order (from 0) of every job that waits."""
        return {
            job.job: (queue, i) for queue, queue_order in self._queues.items() for i, job in enumerate(queue_order.jobs)
        }

    def _before(self, queue: str, cache: PassCache, shape: Shape) -> Reservation | None:
        """The reservation that a job waits behind: one of its own queue, else the first that keeps hosts it could use."""
        hosts = {host for ce in cache.possible(shape) for host in self._resources.members[ce]}
        reservations = [reservation for reservation in cache.reservations if not reservation.hosts.isdisjoint(hosts)]
        return next(
            (reservation for reservation in reservations if reservation.job.queue == queue),
            reservations[0] if reservations else None,
        )

    def _lack(self, shape: Shape, ce: str) -> str:
        """What the compute environment lacks for the shape now, the shape's demand, and the free part."""
        hosts = [self._resources.hosts[name] for name in self._resources.members[ce]]
        if self._resources.cpus[ce] + EPSILON < shape.least.cpus:
            left = count_of(max(0.0, self._resources.cpus[ce]), "CPU")
            return f"compute environment {ce} may use {left} more at this time; {needs(shape)}"
        if limit := limit_of(self._resources.totals(ce)):
            return f"{limit}; {needs(shape)}"
        free = sum((host.resources for host in hosts), Resources())
        short = shortage(shape.least, free) or "enough is free, but not in one piece for each node"
        return f"{short}; {needs(shape)}; {together(hosts)} free"

    def _awaited(self, reservation: Reservation) -> str:
        """The jobs whose end the reservation waits for, and its latest time; empty if it waits for none."""
        preempted = [each for each in reservation.awaits if each.job in self._preempted]
        awaited = preempted or list(reservation.awaits)
        if not awaited:
            return ""
        names = [named(each.name, each.job) for each in awaited[-_NAMED:]]
        who = f"job{'s' if len(awaited) > 1 else ''} {enumerated(names, len(awaited))}"
        if preempted:
            return f"{who}, preempted for it, to stop"
        if all(each.ending for each in awaited):
            return f"{who} to stop"
        return f"{who} to end{self._start(reservation, ', at the latest at ')}"

    def _start(self, reservation: Reservation, lead: str) -> str:
        """The latest start of its job; empty if unknown or imminent."""
        if not self._now < reservation.window.at < inf:
            return ""
        return lead + datetime.fromtimestamp((reservation.window.at + self._drift) / 1000, UTC).strftime(
            "%Y-%m-%d %H:%M:%S UTC"
        )

    def _hint(self, shape: Shape, cache: PassCache) -> str:
        """A message that the shape would fit now, with the timeout under which it could start without delaying another job."""
        ces = cache.open(shape)
        if not any(self._resources.allocation(shape, ce) for ce in ces):
            return ""
        kept = "; it would fit now, but on what is kept for that job"
        unknown = [reservation.window for reservation in cache.reservations if reservation.window.at == inf]
        seconds = int((cache.times[0] - self._now) / 1000) if cache.times else 0
        if seconds < 1 or not any(self._resources.allocation(shape, ce, unknown) for ce in ces):
            return kept
        return f"{kept}: with a timeout of at most {seconds} s it could start"


def _ordinal(number: int) -> str:
    if number % 100 in (11, 12, 13):
        return f"{number}th"
    return f"{number}{ {1: 'st', 2: 'nd', 3: 'rd'}.get(number % 10, 'th') }"
