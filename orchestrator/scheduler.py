"""Who starts now, on which hosts, and why the others wait. Pure functions over a snapshot; the controller carries them out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from orchestrator.definition import GangNeeds, NodeNeeds
from orchestrator.engines.base import Host, Placement


@dataclass(frozen=True)
class Waiting:
    """A RUNNABLE job; the snapshot lists them oldest first."""

    job: str
    name: str
    needs: GangNeeds


@dataclass(frozen=True)
class Start:
    """Launch the job's gang on these hosts, one placement a node by index."""

    job: str
    placements: tuple[Placement, ...]


@dataclass(frozen=True)
class Wait:
    """Leave the job RUNNABLE, and say why."""

    job: str
    reason: str


def decide(
    waiting: Sequence[Waiting], hosts: Sequence[Host], running: Sequence[tuple[str, Sequence[Placement]]]
) -> list[Start | Wait]:
    """A decision for every waiting job.

    Oldest first; a gang is admitted whole or not at all. A gang that has to wait for room holds back the ones behind it, so
    that small jobs can't starve it; one that can never fit holds back nobody.

    Args:
        waiting: RUNNABLE jobs, oldest first.
        hosts: What the engine has in all.
        running: Name and placements of every gang that holds resources.
    """
    free = [_less(host, [p for _, placements in running for p in placements if p.host == host.name]) for host in hosts]
    decisions: list[Start | Wait] = []
    head: Waiting | None = None
    for job in waiting:
        if impossible := never_fits(job.needs, hosts):
            decisions.append(Wait(job.job, f"MISCONFIGURATION:JOB_RESOURCE_REQUIREMENT - {impossible}"))
        elif head is not None:
            decisions.append(
                Wait(job.job, f"behind job {head.name} ({head.job[:8]}) in the queue, which waits for room")
            )
        elif placements := place(job.needs, free):
            decisions.append(Start(job.job, placements))
            free = [_less(host, [p for p in placements if p.host == host.name]) for host in free]
        else:
            head = job
            decisions.append(Wait(job.job, _shortage(job.needs, free, [name for name, _ in running])))
    return decisions


def place(needs: GangNeeds, free: Sequence[Host]) -> tuple[Placement, ...] | None:
    """Where each node would go: as many nodes as fit between the gang's minimum and its size; None where too few do."""
    for count in range(len(needs.nodes), needs.minimum - 1, -1):
        left = list(free)
        nodes = needs.nodes[:count]
        placements: dict[int, Placement] = {}
        # the most demanding node first: a small one must not take the only host that a large one fits on
        for number in sorted(range(count), key=lambda i: (-nodes[i].gpus, -nodes[i].cpus, -nodes[i].memory)):
            node = nodes[number]
            index = next((i for i, host in enumerate(left) if _fits(node, host)), None)
            if index is None:
                break
            placement = Placement(left[index].name, left[index].gpus[: node.gpus], node.cpus, node.memory)
            placements[number] = placement
            left[index] = _less(left[index], [placement])
        if len(placements) == count:
            return tuple(placements[number] for number in range(count))
    return None


def never_fits(needs: GangNeeds, hosts: Sequence[Host]) -> str | None:
    """Why the gang could not start even if everything were free; None where it could."""
    if place(needs, hosts):
        return None
    for node in needs.nodes:
        if not any(_fits(node, host) for host in hosts):
            best = max(hosts, key=lambda h: (len(h.gpus) >= node.gpus, h.cpus >= node.cpus, h.memory), default=None)
            has = _amounts(best.cpus, len(best.gpus), best.memory) if best else "nothing: there is no host"
            return f"each node needs {_amounts(node.cpus, node.gpus, node.memory)}; the largest host has {has}"
    return f"{_total(needs)}; all hosts together have {_free_amounts(hosts)}"


def _fits(node: NodeNeeds, host: Host) -> bool:
    return node.cpus <= host.cpus + 1e-9 and node.gpus <= len(host.gpus) and node.memory <= host.memory


def _less(host: Host, taken: Sequence[Placement]) -> Host:
    gpus = {gpu for placement in taken for gpu in placement.gpus}
    return Host(
        host.name,
        host.cpus - sum(placement.cpus for placement in taken),
        tuple(gpu for gpu in host.gpus if gpu not in gpus),
        host.memory - sum(placement.memory for placement in taken),
    )


def _shortage(needs: GangNeeds, free: Sequence[Host], holders: Sequence[str]) -> str:
    until = f" until {' or '.join(sorted(set(holders))[:3])} ends" if holders else ""
    return f"{_total(needs)}; {_free_amounts(free)} free{until}"


def _total(needs: GangNeeds) -> str:
    nodes = needs.nodes[: needs.minimum]
    at_least = "at least " if needs.minimum < len(needs.nodes) else ""
    amounts = _amounts(sum(n.cpus for n in nodes), sum(n.gpus for n in nodes), sum(n.memory for n in nodes))
    return f"needs {at_least}{len(nodes)} node{'s' if len(nodes) != 1 else ''} with {amounts} in all"


def _free_amounts(hosts: Sequence[Host]) -> str:
    return _amounts(sum(h.cpus for h in hosts), sum(len(h.gpus) for h in hosts), sum(h.memory for h in hosts))


def _amounts(cpus: float, gpus: int, memory: int) -> str:
    parts = [f"{cpus:g} CPU{'s' if cpus != 1 else ''}", f"{gpus} GPU{'s' if gpus != 1 else ''}"]
    amount = f"{memory / 1024:.3g} GiB" if memory >= 1024 else f"{memory} MiB"
    return ", ".join([*parts, amount])
