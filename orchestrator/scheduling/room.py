"""What is free, host by host and pool by pool, while a pass starts gangs or imagines that they end."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from math import inf
from typing import NamedTuple

from orchestrator.engines.base import Host, Placement, engine_of
from orchestrator.scheduling.placement import affordable, less, place
from orchestrator.scheduling.snapshot import Shape, Snapshot


class Seat(NamedTuple):
    """A place for a whole gang."""

    pool: str
    placements: tuple[Placement, ...]


@dataclass
class Spare:
    """What a gang that has reserved leaves to others from the time at which it starts.

    A gang that may run longer than that has to fit into this too; one that ends sooner does not touch it.
    """

    at: float
    """When the reserving gang starts [ms]; infinite where nobody knows."""
    pool: str
    hosts: dict[str, Host]
    """The hosts that it reserves on, and those on the same machines, with what is left of them then. GPUs count by number, not
    by id."""
    cpus: float
    """What others may use of its pool then."""

    def binds(self, end: float) -> bool:
        """Whether a gang that ends at ``end`` [ms] at the latest has to fit into this."""
        return end > self.at or self.at == inf

    def take(self, seat: Seat, room: Room) -> None:
        for placement in seat.placements:
            for host in [self.hosts[name] for name in room.beside(placement.host) if name in self.hosts]:
                cpus, memory = host.cpus - placement.cpus, host.memory - placement.memory
                self.hosts[host.name] = host.left(cpus, host.gpus[len(placement.gpus) :], memory)
            if seat.pool == self.pool:
                self.cpus -= placement.cpus


class Room:
    """What is free of the hosts, and what each pool may still use.

    A host may be in several pools, and a machine may be a host of several engines: what one of them gives away is gone from all.
    Hosts that running gangs name and that are gone count for nothing.
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
        total: What each host has.
        members: Hosts of each pool, in the engine's order.
        hosts: What is free of each.
        cpus: What each pool may still use, infinite for one without ``max_cpus``.
        machines: The hosts of each machine that has several.
        """
        self.total, self.members, self.hosts, self.cpus, self._machines = total, members, hosts, cpus, machines

    @classmethod
    def of(cls, snapshot: Snapshot) -> Room:
        """What the running gangs leave."""
        total = {host.name: host for host in snapshot.hosts}
        machines: dict[str, tuple[str, ...]] = {}
        for host in snapshot.hosts:
            if host.machine:
                machines[host.machine] = (*machines.get(host.machine, ()), host.name)
        members = {}
        for name, pool in snapshot.pools.items():
            allowed = total.keys() if pool.hosts is None else set(pool.hosts)
            mine = [host for host in total if host in allowed and pool.engine in (None, engine_of(host))]
            once: dict[str, str] = {}  # a machine is in a pool once, as the first of its hosts
            for each in mine:
                once.setdefault(total[each].machine or each, each)
            members[name] = tuple(once.values())
        cpus = {name: inf if pool.max_cpus is None else pool.max_cpus for name, pool in snapshot.pools.items()}
        room = cls(total, members, dict(total), cpus, machines)
        taken: dict[str, list[Placement]] = {}
        for gang in snapshot.running:
            for placement in gang.placements:
                for name in room.beside(placement.host):
                    taken.setdefault(name, []).append(placement)
                if gang.pool in cpus:
                    cpus[gang.pool] -= placement.cpus
        for name in taken:
            room.hosts[name] = less(total[name], taken[name])
        return room

    def copy(self) -> Room:
        return Room(self.total, self.members, dict(self.hosts), dict(self.cpus), self._machines)

    def beside(self, host: str) -> tuple[str, ...]:
        """The hosts that are the same machine, itself among them; none for a host that is gone."""
        if (found := self.total.get(host)) is None:
            return ()
        return self._machines[found.machine] if found.machine else (host,)

    def reach(self, pools: Iterable[str]) -> frozenset[str]:
        """The hosts of the pools, and all others that lose what is taken of those."""
        return frozenset(each for pool in pools for host in self.members[pool] for each in self.beside(host))

    def take(self, seat: Seat) -> None:
        for placement in seat.placements:
            for name in self.beside(placement.host):
                self.hosts[name] = less(self.hosts[name], [placement])
            self.cpus[seat.pool] -= placement.cpus

    def release(self, pool: str, placements: Iterable[Placement]) -> None:
        """What the gang held comes free."""
        for placement in placements:
            if pool in self.cpus:
                self.cpus[pool] += placement.cpus
            for host in [self.hosts[name] for name in self.beside(placement.host)]:
                known = self.total[host.name].gpus
                gpus = host.gpus + tuple(gpu for gpu in placement.gpus if gpu in known)
                self.hosts[host.name] = host.left(host.cpus + placement.cpus, gpus, host.memory + placement.memory)

    def totals(self, pool: str) -> list[Host]:
        """The pool's hosts with all that they have."""
        return [self.total[name] for name in self.members[pool]]

    def seat(self, shape: Shape, pool: str, bounds: Sequence[Spare] = (), most: int | None = None) -> Seat | None:
        """A place for the gang in the pool, within what each of the ``bounds`` leaves; of ``most`` nodes, where given."""
        hosts = [self.hosts[name] for name in self.members[pool]]
        cpus = self.cpus[pool]
        for bound in bounds:
            hosts = [_smaller(host, bound.hosts[host.name]) if host.name in bound.hosts else host for host in hosts]
            if bound.pool == pool:
                cpus = min(cpus, bound.cpus)
        if cpus < inf:
            most = min(affordable(shape, cpus), len(shape.nodes) if most is None else most)
        placements = place(shape, hosts, most)
        return Seat(pool, placements) if placements else None


def _smaller(free: Host, spare: Host) -> Host:
    return free.left(min(free.cpus, spare.cpus), free.gpus[: len(spare.gpus)], min(free.memory, spare.memory))
