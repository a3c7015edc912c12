"""The fit of a gang on an idle cluster: passes, plans, submissions and resumes use it to refuse gangs that can never start."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from math import inf

from orchestrator.domain.gang import Shape
from orchestrator.domain.hosts import Host
from orchestrator.domain.reasons import Reason
from orchestrator.scheduling.free_resources import Allocation, FreeResources
from orchestrator.scheduling.placement import affordable, count_of, needs, never_fits
from orchestrator.scheduling.snapshot import ComputeEnvironment, Queue, Snapshot

TOO_MANY_CPUS = "MISCONFIGURATION:COMPUTE_ENVIRONMENT_MAX_RESOURCE"
TOO_LARGE = "MISCONFIGURATION:JOB_RESOURCE_REQUIREMENT"


@dataclass(frozen=True)
class Fit:
    """The answer of an idle queue to a gang."""

    allocation: Allocation | None
    """Hosts on which it would start; None if the hosts known now don't suffice."""
    problem: str | None
    """Why it could never start; None if it could, perhaps on hosts that are added later."""


def fit(
    shape: Shape,
    queue: Queue,
    ces: Mapping[str, ComputeEnvironment],
    hosts: Sequence[Host],
    elastic: Collection[str] = (),
) -> Fit:
    """The queue's answer when all hosts are free.

    Compute environments come in the queue's order, each with its own hosts and its ``max_cpus``; those that are disabled, and
    may be enabled again, come last.

    Args:
        shape: The gang.
        queue: The queue.
        ces: The compute environments by name.
        hosts: All hosts, with all that they have.
        elastic: Names of compute environments that may have more hosts later.
    """
    free = FreeResources.of(
        Snapshot(now=0, hosts=hosts, compute_environments=ces, queues={}, waiting=(), running=(), usage={})
    )
    known = [ces[name] for name in queue.compute_environments if name in ces]
    ordered = [*(ce for ce in known if ce.enabled), *(ce for ce in known if not ce.enabled)]
    for ce in ordered:
        if allocation := free.allocation(shape, ce.name):
            return Fit(allocation, None)
    possible, problem = examine(shape, ordered, free, elastic)
    return Fit(None, None if possible else problem.words)


def examine(
    shape: Shape, ces: Sequence[ComputeEnvironment], free: FreeResources, elastic: Collection[str] = ()
) -> tuple[tuple[str, ...], Reason]:
    """Names of the compute environments into which the gang fits if nothing runs, and why it does not fit into the others."""
    possible, causes, too_many = [], [], 0
    for ce in ces:
        where = f"compute environment {ce.name}: " if len(ces) > 1 else ""
        most = inf if ce.max_cpus is None else ce.max_cpus
        if not affordable(shape, most):
            too_many += 1
            causes.append(f"compute environment {ce.name} has at most {count_of(most, 'CPU')}")
        elif cause := never_fits(shape, free.totals(ce.name), bool(ce.unknown) or ce.name in elastic):
            causes.append(f"{where}{cause}")
        else:
            possible.append(ce.name)
    code = TOO_MANY_CPUS if too_many == len(ces) else TOO_LARGE
    demand = [needs(shape)] if too_many else []
    return tuple(possible), Reason.coded(code, "; ".join([*causes, *demand]))
