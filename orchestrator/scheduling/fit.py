"""Where a gang would go if nothing ran: what a pass, a plan, a submission and a resume say alike of what can never start."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from math import inf

from orchestrator.engines.base import Host
from orchestrator.scheduling.placement import affordable, count_of, needs, never_fits
from orchestrator.scheduling.room import Room, Seat
from orchestrator.scheduling.snapshot import Pool, Queue, Shape, Snapshot

TOO_MANY_CPUS = "MISCONFIGURATION:COMPUTE_ENVIRONMENT_MAX_RESOURCE"
TOO_LARGE = "MISCONFIGURATION:JOB_RESOURCE_REQUIREMENT"


@dataclass(frozen=True)
class Fit:
    """What an idle queue has for a gang."""

    seat: Seat | None
    """Where it would start; None where the hosts that are known now don't suffice."""
    problem: str | None
    """Why it could never start; None where it could, perhaps on hosts that are still to come."""


def fit(
    shape: Shape, queue: Queue, pools: Mapping[str, Pool], hosts: Sequence[Host], elastic: Collection[str] = ()
) -> Fit:
    """What the queue has for the gang when all hosts are free.

    Compute environments come in the queue's order, each with its own hosts and its ``max_cpus``; those that are disabled, and
    may be enabled again, come last.

    Args:
        shape: The gang.
        queue: The queue.
        pools: The compute environments by name.
        hosts: All hosts, with all that they have.
        elastic: Names of compute environments that may have more hosts later.
    """
    room = Room.of(Snapshot(now=0, hosts=hosts, pools=pools, queues={}, waiting=(), running=(), usage={}))
    known = [pools[name] for name in queue.pools if name in pools]
    ordered = [*(pool for pool in known if pool.enabled), *(pool for pool in known if not pool.enabled)]
    for pool in ordered:
        if seat := room.seat(shape, pool.name):
            return Fit(seat, None)
    possible, problem = examine(shape, ordered, room, elastic)
    return Fit(None, None if possible else problem.partition(" - ")[2])


def examine(
    shape: Shape, pools: Sequence[Pool], room: Room, elastic: Collection[str] = ()
) -> tuple[tuple[str, ...], str]:
    """Names of the pools into which the gang fits if nothing runs, and why it does not fit into the others, with a code."""
    possible, causes, too_many = [], [], 0
    for pool in pools:
        where = f"compute environment {pool.name}: " if len(pools) > 1 else ""
        most = inf if pool.max_cpus is None else pool.max_cpus
        if not affordable(shape, most):
            too_many += 1
            causes.append(f"compute environment {pool.name} has at most {count_of(most, 'CPU')}")
        elif cause := never_fits(shape, room.totals(pool.name), pool.name in elastic):
            causes.append(f"{where}{cause}")
        else:
            possible.append(pool.name)
    code = TOO_MANY_CPUS if too_many == len(pools) else TOO_LARGE
    lead = f"{needs(shape)}; " if too_many else ""
    return tuple(possible), f"{code} - {lead}{'; '.join(causes)}"
