"""Machines, and the placement of a gang's nodes on them."""

from __future__ import annotations

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
    away: bool = False
    """Whether it takes no node now but may later. An engine that queues is still given a gang that needs it, and waits."""
    machine: str = ""
    """Shared by the hosts of several engines that are one machine: capacity allocated on one is unavailable on the others. Empty: the
    machine is this host's alone."""

    @cached_property
    def resources(self) -> Resources:
        """Its amount of each kind."""
        return Resources(self.cpus, len(self.gpus), self.memory)

    def left(self, cpus: float, gpus: tuple[str, ...], memory: int) -> Host:
        """The same host with these amounts."""
        return replace(self, cpus=cpus, gpus=gpus, memory=memory)


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
