"""Hosts, and the gangs on them, as they truly are: they work, save and end, whether or not a controller is there."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING

from orchestrator.engines.api import Gang
from shared_store.contract.faults import Fault
from shared_store.volume.node_outcomes import EX_TEMPFAIL, FirstError, Outcome

if TYPE_CHECKING:
    from tests.support.simulation.run import Simulation

_SAVING = 30.0
"""Seconds of work between two checkpoints."""
_CLOSING = 20.0
"""Seconds from the last checkpoint to the end, at most."""
_TRIES = 60
"""Seconds for which a node tries to write its outcome."""

_FAULT = Fault("ValueError", "train.py", 3)


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
    requested: bool = False
    """It was asked to end."""
    silent_since: float | None = None
    """Since when it is frozen or isolated [s]."""
    was_silent: float = 0.0
    """For how long it was, the longest time that is over [s]."""

    def __str__(self) -> str:
        return f"{self.gang.name} node {self.index}"

    @property
    def key(self) -> tuple[str, int, int]:
        return self.gang.job, self.gang.attempt, self.index

    @property
    def acts(self) -> bool:
        """Whether it can reach the others and the volume."""
        return self.alive and not (self.frozen or self.isolated or self.host_lost)


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

    @property
    def running(self) -> list[SimulatedNode]:
        return [node for node in self.nodes if node.alive]


class Cluster:
    """All gangs that were ever launched."""

    def __init__(self, world: Simulation) -> None:
        self._world, self._machine, self._rng = world, world.machine, world.rng
        self.gangs: dict[str, SimulatedGang] = {}
        self._requested: dict[str, float] = {}
        """When each launch was asked for first."""

    @property
    def running(self) -> list[SimulatedNode]:
        return [node for gang in self.gangs.values() for node in gang.running]

    def pulls(self, gang: Gang) -> bool:
        """Whether its image is still being pulled: since its launch was asked for."""
        since = self._requested.setdefault(gang.name, self._machine.time)
        return gang.name not in self.gangs and self._machine.time - since < self._world.job(gang.job).pulling

    def launch(self, gang: Gang) -> None:
        """Start it, once for a name."""
        if gang.name in self.gangs:
            return
        self._world.invariants.check_launch(gang)
        found = SimulatedGang(
            gang.name, gang.job, gang.attempt, gang.epoch, gang.run, self._world.router, self._machine.time
        )
        found.nodes = [SimulatedNode(found, index, each.host) for index, each in enumerate(gang.placements)]
        self.gangs[gang.name] = found
        self._world.invariants.launched(found)
        for node in found.nodes:
            self._world.notice(node, self._rng.uniform(0.5, 3.0))
        self._machine.after(self._world.job(gang.job).breaks[gang.attempt - 1], lambda: self._break(found))
        self._work(found)

    def stop(self, name: str, grace: float) -> None:
        """Ask its nodes to end, wait, and kill them. On a greenlet that may sleep."""
        gang = self.gangs.get(name)
        if gang is None:
            return
        self._world.invariants.check_cause(gang)
        deadline = self._machine.time + grace
        for node in gang.running:
            node.requested = True
            self._machine.after(self._rng.uniform(0.1, 4.0), partial(self._leave, node))
        while gang.running and self._machine.time < deadline:
            self._machine.sleep(0.5)
        for node in gang.running:
            node.alive, node.killed = False, True
            self._world.notice(node, 0.2)

    def can_write(self, node: SimulatedNode) -> bool:
        """Whether it could write to its run."""
        return node.acts and self._world.volume.epoch(node.gang.run) <= node.gang.epoch

    def _work(self, gang: SimulatedGang) -> None:
        """Work until the next save, or the end."""
        job = self._world.job(gang.job)
        left = job.work - job.done
        if left <= 0:
            closing = self._rng.uniform(0.1, _CLOSING)
            self._machine.after(closing, lambda: self._finish(gang.nodes[0], job.code, fault=job.code == 1))
            return
        piece = min(left, _SAVING)
        self._machine.after(piece, lambda: self._save(gang, piece))

    def _save(self, gang: SimulatedGang, piece: float) -> None:
        if not all(node.alive for node in gang.nodes):
            return
        volume = self._world.volume
        if volume.unusable or not all(node.acts for node in gang.nodes):
            self._machine.after(5.0, lambda: self._save(gang, piece))  # the others wait for it
            return
        if volume.epoch(gang.run) > gang.epoch:
            for node in gang.nodes:
                self._finish(node, 1)  # fenced
            return
        job = self._world.job(gang.job)
        job.done += piece
        run = volume.runs[gang.run]
        run.iteration, run.saved[gang.epoch] = int(job.done), self._machine.wall()
        self._work(gang)

    def _break(self, gang: SimulatedGang) -> None:
        """A fault of the job itself: one node fails, and the others' collectives break."""
        if not all(node.alive and not node.frozen for node in gang.nodes):
            return
        first = self._rng.choice(gang.nodes)
        self._finish(first, 1)
        for node in gang.nodes:
            if node is not first:
                self._machine.after(self._rng.uniform(0.5, 5.0), partial(self._finish, node, 1))

    def _leave(self, node: SimulatedNode) -> None:
        """Save and leave with 75."""
        if node.acts:
            self._finish(node, EX_TEMPFAIL)

    def _finish(
        self, node: SimulatedNode, code: int, tries: int = _TRIES, requested: bool | None = None, fault: bool = False
    ) -> None:
        """The node ends: it writes its outcome until that stands, or leaves without one after a while.

        ``requested``: whether it was asked to end when its work ended; None: as it is now. ``fault``: whether the job's own fault ends it.
        """
        if not node.alive:
            return
        was_requested = node.requested if requested is None else requested
        if not node.acts:
            self._machine.after(5.0, lambda: self._finish(node, code, tries, was_requested, fault))
            return
        gang, volume = node.gang, self._world.volume
        can_write = not volume.unusable and gang.run in volume.runs
        if not can_write and tries and not node.requested:
            self._machine.after(1.0, lambda: self._finish(node, code, tries - 1, was_requested, fault))
            return
        if can_write:
            wall, words = self._machine.wall(), f"exit {code}"
            error = FirstError(0, words, "", wall, _FAULT) if fault else None
            outcome = Outcome(node.index, gang.epoch, code, None, words, error, wall - 1, wall, requested=was_requested)
            if fault:
                self._world.job(gang.job).faults.add(gang.attempt)
            volume.runs[gang.run].outcomes[gang.job, gang.attempt, node.index] = outcome
        node.alive, node.exit_code = False, code
        if node.index == 0 and code != EX_TEMPFAIL:
            self._world.job(gang.job).main_ends.append((gang.attempt, code, was_requested))
        self._world.notice(node, 0.2)
        if node.index == 0 and code == 0:
            for other in gang.running:
                self._machine.after(self._rng.uniform(0.1, 12.0), partial(self._finish, other, 0))
