"""Resources in one type: amounts of CPUs, GPUs and memory that are requested, free or allocated."""

from __future__ import annotations

from dataclasses import dataclass

EPSILON = 1e-9
"""Tolerance [CPUs] for rounding errors of fractional CPUs."""


@dataclass(frozen=True, slots=True)
class Resources:
    """An amount of each kind; amounts are added, subtracted and compared kind by kind. GPUs are a number here; a node's GPU ids are in its
    :class:`~orchestrator.domain.hosts.Placement`.
    """

    cpus: float = 0.0
    """CPUs (float): a node may have a fraction of one."""
    gpus: int = 0
    """Whole GPUs (int)."""
    memory: int = 0
    """MiB (int)."""

    def __add__(self, other: Resources) -> Resources:
        return Resources(self.cpus + other.cpus, self.gpus + other.gpus, self.memory + other.memory)

    def __sub__(self, other: Resources) -> Resources:
        """The remainder; negative if there is too little."""
        return Resources(self.cpus - other.cpus, self.gpus - other.gpus, self.memory - other.memory)

    def __le__(self, other: Resources) -> bool:
        """Whether this fits into the other: no kind needs more than there is. Of two amounts neither may fit into the other."""
        return self.cpus <= other.cpus + EPSILON and self.gpus <= other.gpus and self.memory <= other.memory
