"""Usage of attempts: GPU-seconds and CPU-seconds, those whose work was lost, and each share's part."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence

from sqlalchemy import select
from sqlalchemy.orm import Session

from orchestrator.domain.hosts import Placement
from orchestrator.domain.job import Ending
from orchestrator.domain.resources import Resources
from orchestrator.persistence.batch_models import Attempt, Job
from orchestrator.persistence.own_models import ShareUsage
from orchestrator.scheduling.order import decayed


def held_by(attempt: Attempt) -> Resources:
    """Total resources of the nodes of an attempt."""
    return sum((each.resources for each in placements_of(attempt)), Resources())


def utilization(
    attempts: Iterable[tuple[Job, Attempt]], queue: str
) -> tuple[Mapping[str, float], Mapping[str, Mapping[str, float]]]:
    """Amounts that those of these attempts hold that are of a queue, by unit (``VCPU``, ``GPU``): in all, and by share."""
    total: dict[str, float] = defaultdict(float)
    shares: dict[str, dict[str, float]] = defaultdict(lambda: defaultdict(float))
    for job, attempt in attempts:
        if job.queue == queue:
            held = held_by(attempt)
            for unit, amount in (("VCPU", held.cpus), ("GPU", held.gpus)):
                total[unit] += amount
                shares[job.share or ""][unit] += amount
    return total, shares


def placements_of(attempt: Attempt) -> tuple[Placement, ...]:
    """The hosts of an attempt's nodes and the resources allocated to them, by index."""
    return tuple(node.placement for node in attempt.nodes)


def charge(attempt: Attempt, saved: float | None, moment: int) -> None:
    """Record the usage of a closed attempt until ``moment`` (steady time [ms]), and the lost part: all since its last checkpoint.

    ``saved``: when it made that (Unix time [s]); None where it made none.
    """
    assert attempt.stopped_at is not None
    seconds = _held(attempt, moment)
    held = held_by(attempt)
    lost = 0.0 if attempt.ending == Ending.SUCCEEDED else seconds
    if lost and saved is not None:
        lost = min(seconds, max(0.0, attempt.stopped_at / 1000 - saved))
    attempt.gpu_seconds, attempt.cpu_seconds = held.gpus * seconds, held.cpus * seconds
    attempt.wasted_gpu_seconds, attempt.wasted_cpu_seconds = held.gpus * lost, held.cpus * lost


def _held(attempt: Attempt, moment: int) -> float:
    """Seconds for which an attempt has held its resources, at ``moment`` (steady time [ms])."""
    return max(0, moment - (attempt.created_at if attempt.held_since is None else attempt.held_since)) / 1000


def resource_seconds(attempt: Attempt, moment: int) -> float:
    """Usage of an attempt until ``moment`` (steady time [ms]): GPU-seconds, or CPU-seconds where it has no GPUs."""
    seconds = _held(attempt, moment)
    held = held_by(attempt)
    return seconds * (held.gpus or held.cpus)


def add_usage(session: Session, queue: str, share: str, seconds: float, decay: int, moment: int) -> None:
    """Add resource-seconds that a share has used of a queue until ``moment`` (steady time [ms])."""
    usage = session.get(ShareUsage, (queue, share))
    if usage is None:  # it may be another job's, which ends at the same commit
        added = (each for each in session.new if isinstance(each, ShareUsage))
        usage = next((each for each in added if (each.queue, each.share) == (queue, share)), None)
    if usage is None:
        usage = ShareUsage(queue=queue, share=share, seconds=0.0, as_of=moment)
        session.add(usage)
    usage.seconds = decayed(usage.seconds, max(0, moment - usage.as_of) / 1000, decay) + seconds
    usage.as_of = moment


def usage_at(
    session: Session, moment: int, decays: Mapping[str, int], running: Sequence[tuple[Job, Attempt]]
) -> dict[tuple[str, str], float]:
    """(queue, share) → resource-seconds decayed to a moment, with the usage of running gangs until then.

    Args:
        session: The session.
        moment: Steady time [ms].
        decays: ``shareDecaySeconds`` by queue, of the queues that have a policy.
        running: Jobs with their open attempts.
    """
    found: dict[tuple[str, str], float] = {}
    if not decays:
        return found
    for row in session.scalars(select(ShareUsage).where(ShareUsage.queue.in_(decays))):
        left = decayed(row.seconds, max(0, moment - row.as_of) / 1000, decays[row.queue])
        if left > 1e-3:  # forgotten in the end: a share with nothing used is not active
            found[row.queue, row.share] = left
    for job, attempt in running:
        if job.queue in decays:
            key = (job.queue, job.share or "")
            found[key] = found.get(key, 0.0) + resource_seconds(attempt, moment)
    return found
