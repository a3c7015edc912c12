"""Rigs for tests of an engine: each has the engine, and gangs whose nodes end when the test says so."""

from __future__ import annotations

import uuid
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Protocol, Self

from orchestrator.domain.hosts import Placement
from orchestrator.engines.api import Engine, Gang, GangNode, Handle, NodeStatus
from orchestrator.engines.testing.fake import FakeCluster, FakeEngine
from orchestrator.engines.toolkit.statuses import observing_several
from shared_store.volume.epoch import raise_epoch, read_epoch
from shared_store.volume.files import write_atomic
from shared_store.volume.layout import Store
from shared_store.volume.node_outcomes import read_outcome

_SCRIPT = """
end="$MUSTER_STORE/ends/$MUSTER_JOB_ID-$AWS_BATCH_JOB_NODE_INDEX"
until [ -e "$end" ]; do sleep 0.05; done
exit "$(cat "$end")"
"""
"""Script of a node: it leaves with the exit code that is written to its file."""


class Rig(Protocol):
    """The surroundings of an engine, as the suite needs them."""

    engine: Engine

    def new_engine(self) -> Engine:
        """That of another controller, for the same machines."""
        ...

    def gang(self, name: str, nodes: int) -> Gang:
        """A gang of a job of that name, whose nodes run until they are ended; the same each time."""
        ...

    def end(self, handle: Handle, index: int, exit_code: int) -> None:
        """Have a node leave with that exit code."""
        ...

    def exit_code(self, handle: Handle, index: int, status: NodeStatus) -> int | None:
        """The exit code of a node: the engine's, else that of its outcome in the store."""
        ...


class FakeRig:
    """Fake engines on one cluster."""

    def __init__(self) -> None:
        self.cluster = FakeCluster()
        self.engine: Engine = self.new_engine()

    def new_engine(self) -> FakeEngine:
        return FakeEngine(self.cluster)

    def gang(self, name: str, nodes: int) -> Gang:
        return make_gang(f"suite-{name}", "/store", nodes, host="fake/host", command=["any"])

    def end(self, handle: Handle, index: int, exit_code: int) -> None:
        self.cluster.end(handle.gang, index, exit_code)

    def exit_code(self, handle: Handle, index: int, status: NodeStatus) -> int | None:
        return status.exit_code


class ShellRig:
    """An engine that really starts processes, on this machine or on machines that see the same store at the same path."""

    def __init__(self, store: Path, make: Callable[[], Engine], container: Mapping[str, Any] | None = None) -> None:
        """Args:
        store: Where the store is made.
        make: Makes the engine.
        container: ``containerProperties`` of the nodes, where the engine wants an image.
        """
        self.store = Store(store).open()
        (store / "ends").mkdir()
        self._make, self._container = make, container
        self._suite = f"suite-{uuid.uuid4().hex[:8]}"
        """Begins the ids of the jobs: an engine may find gangs by their names on the whole machine."""
        self._jobs: dict[str, int] = {}
        """Their numbers of nodes."""
        self.engine = self.new_engine()

    def new_engine(self) -> Engine:
        return observing_several(self._make())

    def gang(self, name: str, nodes: int) -> Gang:
        job = f"{self._suite}-{name}"
        run = self.store.run(job)
        run.create({"run": job})
        if read_epoch(run) < 1:
            raise_epoch(run, 1)
        host = self.engine.capacity().places[0].name
        containers = [self._container] * nodes if self._container else []
        self._jobs[job] = nodes
        return make_gang(job, str(self.store.path), nodes, host, ["sh", "-c", _SCRIPT], containers)

    def end(self, handle: Handle, index: int, exit_code: int) -> None:
        self._leave(handle.gang.partition("/")[0], index, exit_code)

    def exit_code(self, handle: Handle, index: int, status: NodeStatus) -> int | None:
        job = handle.gang.partition("/")[0]
        outcome = read_outcome(self.store.run(job), job, 1, index)
        return outcome.exit_code if outcome is not None else status.exit_code

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        """Let every node leave that a failed test has left behind."""
        for job, nodes in self._jobs.items():
            for index in range(nodes):
                self._leave(job, index, 0)
        self.engine.close()

    def _leave(self, job: str, index: int, exit_code: int) -> None:
        write_atomic(self.store.path / "ends" / f"{job}-{index}", str(exit_code).encode())


def make_gang(
    job: str,
    store: str,
    nodes: int,
    host: str,
    command: Sequence[str],
    containers: Sequence[Mapping[str, Any]] = (),
) -> Gang:
    """The first attempt of a job from YAML, all of whose nodes run ``command`` on ``host``, each with a fifth of a core."""
    return Gang(
        job=job,
        attempt=1,
        epoch=1,
        job_epoch=1,
        run=job,
        store=store,
        queue="default",
        compute_environment=host.partition("/")[0],
        main=0,
        nodes=[
            GangNode(
                list(command), {"MUSTER_ON_CHILD_FAILURE": "ignore"}, Placement(host, (), 0.2, 64), container=container
            )
            for container in containers or [{}] * nodes
        ],
        grace=1.0,
        directory=None,
        is_native=True,
    )
