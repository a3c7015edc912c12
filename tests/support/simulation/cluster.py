"""Hosts, and the gangs on them, as they truly are; and the engine that tells the controller of them, when it answers."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from orchestrator.domain.hosts import Capacity, Host, Hosts
from orchestrator.engines.api import (
    Cause,
    Gang,
    GangStatus,
    Handle,
    NodePhase,
    NodeStatus,
    NotYet,
    Plan,
    Traits,
    node_plans,
)
from orchestrator.engines.toolkit.endings import ended

if TYPE_CHECKING:
    from tests.support.simulation.run import Simulation

HOSTS = 6
CORES = 2.0


@dataclass
class SimulatedNode:
    """A node of a gang: a supervisor and its ranks."""

    gang: SimulatedGang
    index: int
    host: str
    alive: bool = True
    frozen: bool = False
    """It does nothing, also not end."""
    isolated: bool = False
    """Its own network is down."""
    host_lost: bool = False
    exit_code: int | None = None
    """Of its own; None while it runs, and for one that was killed or vanished."""
    killed: bool = False
    asked: bool = False
    """It was told to end."""
    silent_since: float | None = None
    """Since when it is frozen, isolated or dead by itself."""

    @property
    def key(self) -> tuple[str, int, int]:
        return self.gang.job, self.gang.attempt, self.index


@dataclass
class SimulatedGang:
    """A gang as it was launched."""

    name: str
    job: str
    attempt: int
    epoch: int
    run: str
    router: int
    """The address of the controller's bus that it knows."""
    launched: float
    nodes: list[SimulatedNode] = field(default_factory=list)
    ran: float = 0.0
    """Seconds of work since the last save."""

    @property
    def running(self) -> list[SimulatedNode]:
        return [node for node in self.nodes if node.alive]


class SimulatedEngine:
    """Speaks with the cluster for one process of the controller."""

    name = "simulated"
    traits = Traits()
    address: str | None = None

    def __init__(self, simulation: Simulation) -> None:
        self._simulation = simulation

    def capacity(self) -> Capacity:
        self._reach()
        return Hosts([Host(f"{self.name}/h{index}", CORES, (), 64_000) for index in range(HOSTS)])

    def plan(self, gang: Gang) -> Plan[Gang]:
        addresses = [f"10.0.0.{index + 1}" for index in range(len(gang.commands))]
        return Plan(gang, node_plans(gang, addresses, 29500), gang)

    def launch(self, plan: Plan[Gang]) -> Handle:
        self._reach()
        gang = plan.request
        if self._simulation.pulls(gang):
            raise NotYet("pulling the image")
        self._simulation.crash("before a launch")
        self._simulation.launch(gang)
        self._simulation.crash("after a launch")
        self._reach()  # the answer may be lost
        return Handle(self.name, gang.name, len(plan.nodes), {})

    def observe(self, handle: Handle) -> GangStatus:
        self._reach()
        found = self._simulation.gangs.get(handle.gang)
        return [ended("", None)] * handle.nodes if found is None else [self._status(node) for node in found.nodes]

    def stop(self, handle: Handle, grace: float) -> None:
        self._reach()
        self._simulation.stop(handle.gang, grace)

    def close(self) -> None:
        """Gangs go on."""

    def _reach(self) -> None:
        if self._simulation.engine_down:
            raise OSError("the simulated engine can't be reached")

    def _status(self, node: SimulatedNode) -> NodeStatus:
        address = f"10.0.0.{node.index + 1}"
        if node.alive:
            return NodeStatus(NodePhase.RUNNING, address)
        if node.host_lost:
            return ended(address, None)
        if node.killed:
            return NodeStatus(NodePhase.ENDED, address, cause=Cause.STOPPED, exit_code=137)
        return ended(address, node.exit_code)
