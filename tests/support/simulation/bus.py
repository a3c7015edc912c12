"""The bus of one process of the controller: the real presence, and messages that a broken network loses."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING

from orchestrator.control.presence import Presence

if TYPE_CHECKING:
    from tests.support.simulation.cluster import SimulatedNode
    from tests.support.simulation.run import Simulation


class SimulatedBus:
    endpoint = "tcp/127.0.0.1:7447"

    def __init__(self, world: Simulation) -> None:
        self.presence = Presence()
        self.presence.hear_itself(True)
        self.changed: Callable[[str], None] = lambda _: None
        self._world = world

    def expect(self, job: str, attempt: int, nodes: int, met: Iterable[int] = ()) -> None:
        self.presence.expect(job, attempt, nodes, met)
        for gang in self._world.cluster.gangs.values():
            if (gang.job, gang.attempt) == (job, attempt):
                for node in gang.nodes:
                    self.notice(node)

    def forget(self, job: str, attempt: int) -> None:
        self.presence.forget(job, attempt)

    def token(self, job: str, attempt: int) -> str:
        return "token"

    def listen(self) -> None:
        """One of the nodes that are heard sends something, as each does once a second."""
        for node in self._world.cluster.running:
            if self._world.hears(node) and self.presence.met(node.key) and not self.presence.is_silent(node.key):
                self.presence.sent(node.key)
                return

    def notice(self, node: SimulatedNode) -> None:
        """A node's connection may have come or gone."""
        here = self._world.hears(node)
        silent = self.presence.is_silent(node.key)
        if here and (silent or not self.presence.met(node.key)):
            self.presence.came(node.key)
        elif not here and self.presence.met(node.key) and not silent:
            self.presence.left(node.key)
        else:
            return
        self.changed(node.key[0])
