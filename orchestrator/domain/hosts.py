"""Hosts, the capacity of engines, and the placement of a gang's nodes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

from orchestrator.domain.resources import Resources


@dataclass(frozen=True)
class Host:
    """A machine, or its free part."""

    name: str
    cpus: float
    gpus: tuple[str, ...]
    """Ids, as ``CUDA_VISIBLE_DEVICES`` takes them."""
    memory: int
    """MiB."""
    single: bool = False
    """Whether it takes one node of a gang at most."""
    unavailable: bool = False
    """Whether it takes no node now but may later. An engine that queues still gets a gang that needs it, and waits."""
    machine: str = ""
    """Shared by the hosts of several engines that are one machine: capacity allocated on one is unavailable on the others. Empty: the
    machine is this host's alone."""
    queue: bool = False
    """It is not a machine but what an engine with a queue of its own gives to a gang at most: see :class:`Limit`."""

    @cached_property
    def resources(self) -> Resources:
        """Its amount of each kind."""
        return Resources(self.cpus, len(self.gpus), self.memory)

    def left(self, cpus: float, gpus: tuple[str, ...], memory: int) -> Host:
        """The same host with these amounts."""
        return replace(self, cpus=cpus, gpus=gpus, memory=memory)


@dataclass(frozen=True)
class Limit:
    """The most that a gang may have of a queue whose machines are not known."""

    queue: str
    """The engine's name, a slash, and the queue's."""
    resources: Resources
    """Of all nodes together."""


@dataclass(frozen=True)
class Hosts:
    """The capacity of an engine that runs each node where Muster places it."""

    machines: Sequence[Host]
    """Every host with all that it has, free or not."""

    @property
    def places(self) -> Sequence[Host]:
        """The hosts on which gangs are placed."""
        return self.machines


@dataclass(frozen=True)
class Queued:
    """The capacity of an engine that queues and places gangs by itself.

    A gang that fits while nothing runs is handed over at once, and what runs there is not counted.
    """

    limits: Sequence[Host] | Limit
    """Its machines, or the most that a gang may have where it does not tell them."""

    @property
    def machines(self) -> Sequence[Host]:
        """Every host that is known."""
        return () if isinstance(self.limits, Limit) else self.limits

    @property
    def places(self) -> Sequence[Host]:
        """The hosts on which gangs are placed to find out whether they fit."""
        if not isinstance(self.limits, Limit):
            return self.limits
        most = self.limits.resources
        gpus = tuple(str(number) for number in range(most.gpus))
        return (Host(self.limits.queue, most.cpus, gpus, most.memory, queue=True),)


Capacity = Hosts | Queued

HERE = "localhost"
"""The machine on which the controller runs."""


def engine_of(host: str) -> str:
    """Name of the engine that a host belongs to: hosts are called ``<engine>/<name>``, that of the local one ``localhost``."""
    return host.partition("/")[0] if "/" in host else "local"


@dataclass(frozen=True)
class Placement:
    """The host of one node, and the node's resources there."""

    host: str
    gpus: tuple[str, ...]
    cpus: float
    memory: int
    """MiB."""

    @cached_property
    def resources(self) -> Resources:
        """Its amount of each kind."""
        return Resources(self.cpus, len(self.gpus), self.memory)
