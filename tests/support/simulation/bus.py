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
        self._gone: set[tuple[str, int, int]] = set()
        """Nodes that this process has heard, and does not hear any more."""

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
            if self._world.hears(node) and self.presence.met(node.key) and node.key not in self._gone:
                self.presence.sent(node.key)
                return

    def notice(self, node: SimulatedNode) -> None:
        """A node's connection may have come or gone."""
        here = self._world.hears(node)
        gone, met = node.key in self._gone, self.presence.met(node.key)
        if here and (gone or not met):
            self.presence.came(node.key)
            self._gone.discard(node.key)
        elif not here and met and not gone:
            self.presence.left(node.key)
            self._gone.add(node.key)
        else:
            return
        self.changed(node.key[0])
