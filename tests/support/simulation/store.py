"""A volume that stalls, fills up, fails, or is not there; and the calls of one process of the controller on it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from orchestrator.control.run_store import ObservedRun, RunContent, RunStore
from shared_store.volume.epoch import Claim
from shared_store.volume.layout import Store
from shared_store.volume.node_outcomes import Outcome

if TYPE_CHECKING:
    from tests.support.simulation.run import Simulation


NO_VOLUME = "the volume of the store does not answer, is full, or is another one"
_NOTICED = 5.0
"""Seconds after which the controller knows of a volume that can't be used."""


@dataclass
class SimulatedRun:
    """What the volume holds of a run."""

    description: Mapping[str, Any] | None = None
    epoch: int = 0
    iteration: int | None = None
    """Of its newest checkpoint."""
    saved: dict[int, float] = field(default_factory=dict)
    """When each epoch made its newest checkpoint (Unix time [s])."""
    outcomes: dict[tuple[str, int, int], Outcome] = field(default_factory=dict)


@dataclass
class Volume:
    """The shared volume, as it is for everybody."""

    runs: dict[str, SimulatedRun] = field(default_factory=dict)
    stalled: bool = False
    """Calls do not return."""
    full: bool = False
    absent: bool = False
    """An empty directory is in its place."""
    failing: bool = False

    @property
    def unusable(self) -> bool:
        return self.stalled or self.full or self.absent or self.failing

    def epoch(self, name: str) -> int:
        """The epoch of a run, as it truly is."""
        return self.runs[name].epoch if name in self.runs else 0

    def read(self, name: str) -> SimulatedRun:
        """Raises OSError."""
        if self.failing:
            raise OSError(5, "Input/output error")
        return SimulatedRun() if self.absent else self.runs.get(name, SimulatedRun())

    def write(self, name: str) -> SimulatedRun:
        """Raises OSError."""
        if self.full:
            raise OSError(28, "No space left on device")
        if self.absent:
            return SimulatedRun()  # below the mount point: it is lost
        if self.failing:
            raise OSError(5, "Input/output error")
        return self.runs.setdefault(name, SimulatedRun())


@dataclass
class SimulatedPeers:
    id: str = "controller"


class SimulatedRunStore(RunStore):
    """The calls, with the real rules of what an answer is worth."""

    def __init__(self, world: Simulation) -> None:
        super().__init__(Store("/simulated"), SimulatedPeers(), self._check_volume)  # type: ignore[arg-type]
        self._world = world

    def _check_volume(self) -> None:
        self._wait()
        if self._world.volume.absent:
            raise OSError("the store is not the one that the database knows")

    def _wait(self) -> None:
        while self._world.volume.stalled:
            self._world.machine.sleep(1.0)

    def examine(self, name: str) -> ObservedRun:
        def body() -> ObservedRun:
            self._wait()
            run = self._world.volume.read(name)
            return ObservedRun(name, run.description is None, run.description, epoch=run.epoch)

        return self._call(f"read run {name}", body)

    def claim(self, name: str, description: Mapping[str, Any], after: int, claim: Claim, texts: object = ()) -> int:
        def body() -> int:
            self._wait()
            run = self._world.volume.write(name)
            run.description = run.description or description
            self._world.write("before an epoch")
            run.epoch = max(run.epoch, after) + 1
            self._world.write("after an epoch")
            return run.epoch

        return self._call(f"prepare run {name}", body)

    def outcomes(self, name: str, job: str, attempt: int, nodes: Sequence[int]) -> Mapping[int, Outcome]:
        def body() -> Mapping[int, Outcome]:
            self._wait()
            found = self._world.volume.read(name).outcomes
            return {node: found[job, attempt, node] for node in nodes if (job, attempt, node) in found}

        return self._call("read outcomes", body)

    def progress(self, name: str, epoch: int) -> RunContent:
        def body() -> RunContent:
            self._wait()
            run = self._world.volume.read(name)
            return RunContent(run.iteration, run.saved.get(epoch))

        return self._call(f"read the checkpoints of run {name}", body)

    def release(self, name: str, epoch: int) -> None:
        """There is no other controller."""


class SimulatedDisk:
    """What the controller's watch on its volumes says, some seconds later than it is so."""

    names = ("store", "database")

    def __init__(self, world: Simulation) -> None:
        self._world = world
        self._since: float | None = None
        """Since when a volume can't be used, as far as was looked."""

    def start(self) -> None:
        """Nothing has to be started."""

    def close(self) -> None:
        """Nothing has to be stopped."""

    def shortage(self, purpose: str | None = None) -> str | None:
        volume, machine = self._world.volume, self._world.machine
        bad = volume.stalled or volume.full or volume.absent
        self._since = (self._since if self._since is not None else machine.time) if bad else None
        if purpose == "database" or self._since is None or machine.time - self._since < _NOTICED:
            return None
        return NO_VOLUME
