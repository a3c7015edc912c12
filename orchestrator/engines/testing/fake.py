"""A fake engine, of which a test decides everything: how its nodes are, when it hangs, what fails."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass, field

from orchestrator.domain.hosts import Capacity, Host, Hosts
from orchestrator.engines.api import (
    Cause,
    Gang,
    GangStatus,
    Handle,
    NodePhase,
    NodeStatus,
    Plan,
    StatusOrError,
    Traits,
    node_plans,
)
from orchestrator.engines.toolkit.statuses import ended, one_by_one


@dataclass
class FakeCluster:
    """The machines of fake engines, and the gangs on them: they outlive each of the engines."""

    gangs: dict[str, list[NodeStatus]] = field(default_factory=dict)
    """Statuses of the nodes of each gang, by its name; a test may put other ones there."""
    launched: list[Plan[Gang]] = field(default_factory=list)
    """Plans of the gangs that were started, in their order."""

    def end(self, gang: str, index: int, exit_code: int | None, words: str = "") -> None:
        """Have a node end; without an exit code its host is lost."""
        self.gangs[gang][index] = ended(self.gangs[gang][index].address, exit_code, words)


class FakeEngine:
    """An engine that starts nothing. A node runs from its launch on until a test, or a stop, ends it."""

    name = "fake"
    traits = Traits()
    """A test may give an engine others."""
    address: str | None = None

    def __init__(self, cluster: FakeCluster | None = None, capacity: Capacity | None = None) -> None:
        """Args:
        cluster: What its gangs run on; one of its own by default.
        capacity: What it has; one host of 8 cores and 8 GiB by default.
        """
        self.cluster = cluster or FakeCluster()
        self.offered = capacity or Hosts([Host(f"{self.name}/host", 8.0, (), 8192)])
        self.error: Exception | None = None
        """Raised by every call, until it is None again."""
        self.answers = threading.Event()
        """While it is clear, calls on the engine's thread hang."""
        self.answers.set()
        self.threads: set[str] = set()
        """Names of the threads on which it was called for its hosts, launches and looks."""
        self.closed = 0
        """Number of times that it was closed."""
        self.polls = 0
        """Number of times that it was asked for statuses."""

    def capacity(self) -> Capacity:
        self._called()
        return self.offered

    def plan(self, gang: Gang) -> Plan[Gang]:
        return Plan(gang, node_plans(gang, [f"10.0.0.{index + 1}" for index in range(len(gang.nodes))], 29500), gang)

    def launch(self, plan: Plan[Gang]) -> Handle:
        self._called()
        name = plan.request.name
        if name not in self.cluster.gangs:
            self.cluster.launched.append(plan)
            nodes = [NodeStatus(NodePhase.RUNNING, node.contract.address or "") for node in plan.nodes]
            self.cluster.gangs[name] = nodes
        return Handle(self.name, name, len(plan.nodes), {})

    def observe(self, handles: Sequence[Handle]) -> Sequence[StatusOrError]:
        self._called()
        self.polls += 1
        return one_by_one(self._observe, handles)

    def _observe(self, handle: Handle) -> GangStatus:
        nodes = self.cluster.gangs.get(handle.gang)
        return [ended("", None)] * handle.nodes if nodes is None else list(nodes)

    def stop(self, handle: Handle, grace: float) -> None:
        if self.error is not None:
            raise self.error
        for index, node in enumerate(self.cluster.gangs.get(handle.gang, [])):
            if node.running:
                over = NodeStatus(NodePhase.ENDED, node.address, cause=Cause.STOPPED, exit_code=143)
                self.cluster.gangs[handle.gang][index] = over

    def close(self) -> None:
        self.closed += 1

    def _called(self) -> None:
        self.threads.add(threading.current_thread().name)
        self.answers.wait()
        if self.error is not None:
            raise self.error
