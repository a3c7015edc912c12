"""Placement of a gang's nodes on hosts."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from math import inf

from orchestrator.domain.gang import Shape
from orchestrator.domain.hosts import Host, Placement
from orchestrator.domain.resources import EPSILON, Resources
from shared_store.contract.error_text import counted


def place(shape: Shape, free: Sequence[Host], most: int | None = None) -> tuple[Placement, ...] | None:
    """The placement of each node: of as many nodes as fit, between the gang's minimum and its size; None if too few do.

    Args:
        shape: The gang.
        free: The free part of each host, in the order in which hosts are filled.
        most: No more nodes than this; None for the gang's size.

    Unavailable hosts are taken only where the gang can't start without them.
    """
    available = [host for host in free if not host.unavailable]
    placements = _place(shape, available, most)
    if placements is None and len(available) < len(free) and (most is None or most >= shape.minimum):
        return _place(shape, [*available, *(host for host in free if host.unavailable)], shape.minimum)
    return placements


def _place(shape: Shape, free: Sequence[Host], most: int | None) -> tuple[Placement, ...] | None:
    count = len(shape.nodes) if most is None else min(most, len(shape.nodes))
    if len(shape.groups) == 1:  # equal nodes: the number that fits is a sum, and no other number needs to be tried
        count = min(count, _seats(shape.nodes[0], free, count))
        return _pack(shape, count, free, tight=False) if count >= shape.minimum else None
    for number in range(count, shape.minimum - 1, -1):
        # first the hosts as they come; where that fails, the tightest ones, so that a small node leaves the only host
        # that a large one fits on
        for tight in (False, True):
            if placements := _pack(shape, number, free, tight):
                return placements
    return None


def never_fits(shape: Shape, hosts: Sequence[Host], elastic: bool = False) -> str | None:
    """Why the gang could not start even on idle hosts; None if it could.

    ``elastic``: hosts may be added, no larger than the known ones.
    """
    if place(shape, hosts) or (elastic and not hosts):
        return None
    for node in shape.nodes[: shape.minimum]:
        if not any(_room(node, host) for host in hosts):
            best = max(hosts, key=lambda h: (len(h.gpus) >= node.gpus, h.cpus >= node.cpus, h.memory), default=None)
            has = amounts(best.resources) if best else "nothing: there is no host"
            return f"each node needs {amounts(node)}; {limit_of(hosts) or f'the largest host has {has}'}"
    if elastic:
        return None
    if too_few := _too_few_hosts(shape, hosts):
        return too_few
    return f"{needs(shape)}; {limit_of(hosts) or f'all hosts together have {together(hosts)}'}"


def limit_of(hosts: Iterable[Host]) -> str | None:
    """The limit of an engine's own queue, in words; None for hosts that are machines."""
    queue = next((host for host in hosts if host.queue), None)
    return f"queue {queue.name} gives a gang at most {amounts(queue.resources)}" if queue else None


def _too_few_hosts(shape: Shape, hosts: Sequence[Host]) -> str | None:
    """A message that hosts are too few, if each takes one node; None if that is not the reason."""
    if not all(host.single for host in hosts):
        return None
    demanded = {"": (shape.minimum, len(hosts))}
    for node, indices in shape.groups:
        count = sum(index < shape.minimum for index in indices)
        demanded[f" with {amounts(node)}"] = count, sum(_room(node, host) for host in hosts)
    for what, (count, found) in demanded.items():
        if found < count:
            at_least = "at least " if shape.minimum < len(shape.nodes) else ""
            present = f"there {'is' if found == 1 else 'are'} {found}"
            return f"needs {at_least}{count} hosts{what}, one for each node; {present}"
    return None


def affordable(shape: Shape, cpus: float = inf, gpus: float = inf) -> int:
    """Number of the gang's first nodes that stay within these amounts in all; 0 where that is less than its minimum."""
    count = 0
    for node in shape.nodes:
        cpus, gpus = cpus - node.cpus, gpus - node.gpus
        if cpus < -EPSILON or gpus < -EPSILON:
            break
        count += 1
    return count if count >= shape.minimum else 0


def less(host: Host, taken: Iterable[Placement]) -> Host:
    """The rest of the host beside these nodes."""
    left, gone = host.resources, set[str]()
    for placement in taken:
        left -= placement.resources
        gone.update(placement.gpus)
    return host.left(left.cpus, tuple(gpu for gpu in host.gpus if gpu not in gone) if gone else host.gpus, left.memory)


def needs(shape: Shape) -> str:
    """The gang's smallest demand, in words."""
    at_least = "at least " if shape.minimum < len(shape.nodes) else ""
    nodes = counted(shape.minimum, "node")
    return f"needs {at_least}{nodes} with {amounts(shape.least)} in all"


def shortage(requested: Resources, free: Resources) -> str:
    """What is missing: ``1 of 2 CPUs, 512 MiB of 1 GiB short``; empty if enough is free in all."""
    parts = []
    if free.cpus + EPSILON < requested.cpus:
        lack = requested.cpus - max(0.0, free.cpus)
        parts.append(f"{_number(lack) if lack >= 0.01 else 'less than 0.01'} of {count_of(requested.cpus, 'CPU')}")
    if free.gpus < requested.gpus:
        parts.append(f"{requested.gpus - max(0, free.gpus)} of {count_of(requested.gpus, 'GPU')}")
    if free.memory < requested.memory:
        parts.append(f"{_size(requested.memory - max(0, free.memory))} of {_size(requested.memory)}")
    return f"{', '.join(parts)} short" if parts else ""


def together(hosts: Sequence[Host]) -> str:
    """The total of the hosts, in words."""
    return amounts(sum((host.resources for host in hosts), Resources()))


def amounts(resources: Resources) -> str:
    """``4 CPUs, 1 GPU, 2 GiB``; negative amounts are shown as 0."""
    size = _size(max(0, resources.memory))
    return f"{count_of(max(0, resources.cpus), 'CPU')}, {count_of(resources.gpus, 'GPU')}, {size}"


def _size(memory: int) -> str:
    return f"{memory / 1024:.3g} GiB" if memory >= 1024 else f"{memory} MiB"


def _number(value: float) -> str:
    return f"{value:.2f}".rstrip("0").rstrip(".")


def count_of(number: float, what: str) -> str:
    """``1 CPU``, ``2.5 CPUs``, ``96000 CPUs``."""
    text = _number(number)
    return f"{text} {what}{'s' if text != '1' else ''}"


def _room(node: Resources, host: Host) -> int:
    """Number of such nodes that fit on the free part of the host."""
    free = host.resources
    if not node <= free:
        return 0
    by_cpus = (free.cpus + EPSILON) // node.cpus if node.cpus > 0 else inf
    by_gpus = free.gpus // node.gpus if node.gpus else inf
    by_memory = free.memory // node.memory if node.memory > 0 else inf
    most = 1 if host.single else 1_000_000
    return int(min(by_cpus, by_gpus, by_memory, most))  # a node that takes nothing fits any number of times


def _seats(node: Resources, free: Sequence[Host], enough: int) -> int:
    """Number of such nodes that fit on all hosts; counting stops at ``enough``."""
    seats = 0
    for host in free:
        seats += _room(node, host)
        if seats >= enough:
            break
    return seats


def _pack(shape: Shape, count: int, free: Sequence[Host], tight: bool) -> tuple[Placement, ...] | None:
    """Put the first ``count`` nodes on hosts, the most demanding first; None if one of them fits nowhere."""
    left = list(free)
    placements: dict[int, Placement] = {}
    for node, indices in shape.groups:
        waiting = [index for index in indices if index < count]
        sizes = [(len(host.gpus), host.cpus, host.memory) for host in left] if tight else []
        for position in sorted(range(len(left)), key=sizes.__getitem__) if tight else range(len(left)):
            if not waiting:
                break
            host = left[position]
            here, waiting = waiting[: (room := _room(node, host))], waiting[room:]
            if here:
                seated = [
                    Placement(host.name, host.gpus[k * node.gpus : (k + 1) * node.gpus], node.cpus, node.memory)
                    for k in range(len(here))
                ]
                placements.update(zip(here, seated, strict=True))
                # -1: even a node that takes nothing finds no room beside another
                left[position] = host.left(-1.0, (), 0) if host.single else less(host, seated)
        if waiting:
            return None
    return tuple(placements[index] for index in range(count))
