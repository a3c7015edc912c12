"""Free resources per host and per compute environment, while a pass starts gangs or simulates their ends."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from math import inf
from typing import NamedTuple

from orchestrator.domain.gang import Shape
from orchestrator.domain.hosts import Host, Placement, engine_of
from orchestrator.scheduling.placement import affordable, less, place
from orchestrator.scheduling.snapshot import Snapshot


class Allocation(NamedTuple):
    """A place for a whole gang."""

    compute_environment: str
    placements: tuple[Placement, ...]


@dataclass
class BackfillWindow:
    """The resources that a gang with a reservation leaves to others from its start on.

    A gang that may still run then has to fit into this, too; one that ends earlier is not affected.
    """

    at: float
    """When the reserving gang starts [ms]; infinite if unknown."""
    compute_environment: str
    hosts: dict[str, Host]
    """The reserved hosts, and those on the same machines, with what is left of them then. GPUs count by number, not
    by id."""
    cpus: float
    """CPUs of its compute environment that others may use then."""

    def binds(self, end: float) -> bool:
        """Whether a gang that ends at ``end`` [ms] at the latest has to fit into this."""
        return end > self.at or self.at == inf

    def take(self, allocation: Allocation, free: FreeResources) -> None:
        for placement in allocation.placements:
            for host in [self.hosts[name] for name in free.beside(placement.host) if name in self.hosts]:
                left = host.resources - placement.resources
                self.hosts[host.name] = host.left(left.cpus, host.gpus[len(placement.gpus) :], left.memory)
            if allocation.compute_environment == self.compute_environment:
                self.cpus -= placement.cpus


class FreeResources:
    """The free part of each host, and the CPUs that each compute environment may still use.

    A host may be in several compute environments, and a machine may be a host of several engines: capacity allocated in one is unavailable
    in all.
    Hosts of running gangs that no engine reports any more are ignored.
    """

    def __init__(
        self,
        total: dict[str, Host],
        members: dict[str, tuple[str, ...]],
        hosts: dict[str, Host],
        cpus: dict[str, float],
        machines: dict[str, tuple[str, ...]],
    ) -> None:
        """Args:
        total: All resources of each host.
        members: Hosts of each compute environment, in the engine's order.
        hosts: The free resources of each.
        cpus: CPUs that each compute environment may still use, infinite for one without ``max_cpus``.
        machines: The hosts of each machine that has several.
        """
        self.total, self.members, self.hosts, self.cpus, self._machines = total, members, hosts, cpus, machines

    @classmethod
    def of(cls, snapshot: Snapshot) -> FreeResources:
        """The resources that the running gangs leave."""
        total = {host.name: host for host in snapshot.hosts}
        machines: dict[str, tuple[str, ...]] = {}
        for host in snapshot.hosts:
            if host.machine:
                machines[host.machine] = (*machines.get(host.machine, ()), host.name)
        members = {}
        for name, ce in snapshot.compute_environments.items():
            allowed = total.keys() if ce.hosts is None else set(ce.hosts)
            mine = [host for host in total if host in allowed and ce.engine in (None, engine_of(host))]
            once: dict[str, str] = {}  # a machine is in a compute environment once, as the first of its hosts
            for each in mine:
                once.setdefault(total[each].machine or each, each)
            members[name] = tuple(once.values())
        cpus = {name: inf if ce.max_cpus is None else ce.max_cpus for name, ce in snapshot.compute_environments.items()}
        free = cls(total, members, dict(total), cpus, machines)
        taken: dict[str, list[Placement]] = {}
        for gang in snapshot.running:
            for placement in gang.placements:
                for name in free.beside(placement.host):
                    taken.setdefault(name, []).append(placement)
                if gang.compute_environment in cpus:
                    cpus[gang.compute_environment] -= placement.cpus
        for name in taken:
            free.hosts[name] = less(total[name], taken[name])
        return free

    def copy(self) -> FreeResources:
        return FreeResources(self.total, self.members, dict(self.hosts), dict(self.cpus), self._machines)

    def beside(self, host: str) -> tuple[str, ...]:
        """The hosts on the same machine, including this one; none if the host is gone."""
        if (found := self.total.get(host)) is None:
            return ()
        return self._machines[found.machine] if found.machine else (host,)

    def reach(self, ces: Iterable[str]) -> frozenset[str]:
        """The hosts of the compute environments, and all others on the same machines."""
        return frozenset(each for ce in ces for host in self.members[ce] for each in self.beside(host))

    def take(self, allocation: Allocation) -> None:
        for placement in allocation.placements:
            for name in self.beside(placement.host):
                self.hosts[name] = less(self.hosts[name], [placement])
            self.cpus[allocation.compute_environment] -= placement.cpus

    def release(self, ce: str, placements: Iterable[Placement]) -> None:
        """Return the gang's resources."""
        for placement in placements:
            if ce in self.cpus:
                self.cpus[ce] += placement.cpus
            for host in [self.hosts[name] for name in self.beside(placement.host)]:
                known = self.total[host.name].gpus
                gpus = host.gpus + tuple(gpu for gpu in placement.gpus if gpu in known)
                left = host.resources + placement.resources
                self.hosts[host.name] = host.left(left.cpus, gpus, left.memory)

    def totals(self, ce: str) -> list[Host]:
        """The compute environment's hosts with all that they have."""
        return [self.total[name] for name in self.members[ce]]

    def allocation(
        self, shape: Shape, ce: str, bounds: Sequence[BackfillWindow] = (), most: int | None = None
    ) -> Allocation | None:
        """A place for the gang in the compute environment, within the remainder of each of the ``bounds``; of ``most`` nodes, where given."""
        hosts = [self.hosts[name] for name in self.members[ce]]
        cpus = self.cpus[ce]
        for bound in bounds:
            hosts = [_smaller(host, bound.hosts[host.name]) if host.name in bound.hosts else host for host in hosts]
            if bound.compute_environment == ce:
                cpus = min(cpus, bound.cpus)
        if cpus < inf:
            most = min(affordable(shape, cpus), len(shape.nodes) if most is None else most)
        placements = place(shape, hosts, most)
        return Allocation(ce, placements) if placements else None


def _smaller(free: Host, window: Host) -> Host:
    return free.left(min(free.cpus, window.cpus), free.gpus[: len(window.gpus)], min(free.memory, window.memory))
