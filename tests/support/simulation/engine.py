"""The engine that one process of the controller has: it speaks with the cluster, when it answers."""

from __future__ import annotations

from collections.abc import Sequence
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
    StatusOrError,
    Traits,
    node_plans,
)
from orchestrator.engines.toolkit.statuses import ended, one_by_one
from tests.support.simulation.cluster import SimulatedNode

if TYPE_CHECKING:
    from tests.support.simulation.run import Simulation

HOSTS = 6
CORES = 2.0
ABSENT = "the simulated engine can't be reached"
HANGS = "the simulated engine has not answered since"


class SimulatedEngine:
    name = "simulated"
    traits = Traits()
    address: str | None = None

    def __init__(self, world: Simulation) -> None:
        self._world = world

    def capacity(self) -> Capacity:
        self._reach()
        return Hosts([Host(f"{self.name}/h{index}", CORES, (), 64_000) for index in range(HOSTS)])

    def plan(self, gang: Gang) -> Plan[Gang]:
        self._world.invariants.check_request(gang)
        addresses = [f"10.0.0.{index + 1}" for index in range(len(gang.nodes))]
        return Plan(gang, node_plans(gang, addresses, 29500), gang)

    def launch(self, plan: Plan[Gang]) -> Handle:
        self._reach()
        gang = plan.request
        if self._world.cluster.pulls(gang):
            raise NotYet("pulling the image")
        self._world.write("before a launch")
        self._world.cluster.launch(gang)
        self._world.write("after a launch")
        self._reach()  # the answer may be lost
        return Handle(self.name, gang.name, len(plan.nodes), {})

    def observe(self, handles: Sequence[Handle]) -> Sequence[StatusOrError]:
        self._reach()
        return one_by_one(self._observe, handles)

    def _observe(self, handle: Handle) -> GangStatus:
        found = self._world.cluster.gangs.get(handle.gang)
        return [ended("", None)] * handle.nodes if found is None else [_status(node) for node in found.nodes]

    def stop(self, handle: Handle, grace: float) -> None:
        self._reach()
        self._world.cluster.stop(handle.gang, grace)

    def close(self) -> None:
        """Gangs go on."""

    def _reach(self) -> None:
        while self._world.engine_hangs:
            self._world.machine.sleep(1.0)
        if self._world.engine_down:
            raise OSError(ABSENT)


def _status(node: SimulatedNode) -> NodeStatus:
    address = f"10.0.0.{node.index + 1}"
    if node.alive:
        return NodeStatus(NodePhase.RUNNING, address)
    if node.killed:
        return NodeStatus(NodePhase.ENDED, address, cause=Cause.STOPPED, exit_code=137)
    return ended(address, None if node.host_lost else node.exit_code)
