"""What a fair-share queue keeps free for shares that are not active (``computeReservation``)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from orchestrator.engines.base import Host, Placement
from orchestrator.scheduling.snapshot import Queue, Running, Shape, Waiting

_FORGOTTEN = 1.0
"""Past use [resource-seconds] below which a share counts as inactive: decay alone never ends."""


@dataclass
class Quota:
    """What one queue may use of each pool, and what it uses already."""

    kept: float
    """Fraction of a pool that is kept: (reservation / 100) ^ active shares."""
    active: int
    used: dict[str, list[float]] = field(default_factory=dict)
    """By pool: CPUs and GPUs of the queue's gangs."""

    def take(self, pool: str, placements: Iterable[Placement]) -> None:
        used = self.used.setdefault(pool, [0.0, 0.0])
        for placement in placements:
            used[0] += placement.cpus
            used[1] += len(placement.gpus)

    def used_of(self, pool: str, gpus: bool) -> float:
        return self.used.get(pool, [0.0, 0.0])[1 if gpus else 0]

    def limit(self, gpus: bool, hosts: Sequence[Host], max_cpus: float) -> float:
        """How many GPUs (else CPUs) the queue may use in all of a pool that has these hosts."""
        total = sum(len(host.gpus) for host in hosts) if gpus else min(max_cpus, sum(host.cpus for host in hosts))
        return total * (1 - self.kept)

    def left(self, shape: Shape, pool: str, hosts: Sequence[Host], max_cpus: float) -> float:
        """How many GPUs (CPUs for a gang without) the queue may still take of the pool."""
        return self.limit(shape.uses_gpus, hosts, max_cpus) - self.used_of(pool, shape.uses_gpus)


def quota_of(
    queue: Queue, waiting: Iterable[Waiting], running: Sequence[Running], usage: Mapping[tuple[str, str], float]
) -> Quota | None:
    """The queue's quota; None for a queue that keeps nothing.

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
        quota.take(gang.pool, gang.placements)
    return quota
