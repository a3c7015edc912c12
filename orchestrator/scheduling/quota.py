"""The quota of inactive shares: the part of a fair-share queue's capacity that is kept for them (``computeReservation``)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from orchestrator.domain.gang import Shape
from orchestrator.domain.hosts import Host, Placement
from orchestrator.scheduling.snapshot import Queue, RunningGang, Waiting

_FORGOTTEN = 1.0
"""Past use [resource-seconds] below which a share counts as inactive: decay alone never ends."""


@dataclass
class Quota:
    """The limit of one queue in each compute environment, and its present use."""

    kept: float
    """Fraction of a compute environment that stays reserved: (reservation / 100) ^ active shares."""
    active: int
    used: dict[str, list[float]] = field(default_factory=dict)
    """By compute environment: CPUs and GPUs of the queue's gangs."""

    def take(self, ce: str, placements: Iterable[Placement]) -> None:
        used = self.used.setdefault(ce, [0.0, 0.0])
        for placement in placements:
            used[0] += placement.cpus
            used[1] += len(placement.gpus)

    def used_of(self, ce: str, gpus: bool) -> float:
        return self.used.get(ce, [0.0, 0.0])[1 if gpus else 0]

    def limit(self, gpus: bool, hosts: Sequence[Host], max_cpus: float) -> float:
        """The queue's limit in a compute environment with these hosts, in GPUs (else CPUs)."""
        total = sum(len(host.gpus) for host in hosts) if gpus else min(max_cpus, sum(host.cpus for host in hosts))
        return total * (1 - self.kept)

    def left(self, shape: Shape, ce: str, hosts: Sequence[Host], max_cpus: float) -> float:
        """GPUs (CPUs for a gang without GPUs) that the queue may still take of the compute environment."""
        return self.limit(shape.uses_gpus, hosts, max_cpus) - self.used_of(ce, shape.uses_gpus)


def quota_of(
    queue: Queue, waiting: Iterable[Waiting], running: Sequence[RunningGang], usage: Mapping[tuple[str, str], float]
) -> Quota | None:
    """The queue's quota; None for a queue without a reservation.

    A share is active while it has a waiting or running job, or use in the recent past.

    Args:
        queue: The queue.
        waiting: Its RUNNABLE jobs.
        running: The gangs of all queues.
        usage: (queue, share) → resource-seconds.
    """
    if queue.policy is None or queue.policy.reservation == 0:
        return None
    own = [gang for gang in running if gang.queue == queue.name]
    active = {job.share or "" for job in waiting} | {gang.share or "" for gang in own}
    active |= {share for (name, share), used in usage.items() if name == queue.name and used >= _FORGOTTEN}
    quota = Quota((queue.policy.reservation / 100) ** len(active), len(active))
    for gang in own:
        quota.take(gang.compute_environment, gang.placements)
    return quota
