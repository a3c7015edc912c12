"""An engine on a real cluster, a store, and the gangs that a test submits."""

from __future__ import annotations

import dataclasses
import json
import time
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from orchestrator.engines.base import Gang, NodeStatus, NotYet, Placement
from orchestrator.engines.slurm import SlurmEngine
from shared_store.epoch import raise_epoch
from shared_store.layout import Store
from shared_store.logs import LogFollower
from tests.conftest import wait_for
from tests.support.engines.sites import WAIT
from tests.support.engines.slurm_cluster import SlurmCluster


class Bench:
    """An engine on the cluster, a store, and the gangs that were submitted."""

    def __init__(self, cluster: SlurmCluster, home: Path) -> None:
        self.cluster, self.store = cluster, Store(home / "store").open()
        self.run = self.store.run("run")
        self.run.create({"run": "run"})
        raise_epoch(self.run, 1)
        self.engine = SlurmEngine()
        self.job = str(uuid.uuid4())
        self.handles: list[str] = []

    def gang(self, script: str = WAIT, nodes: int = 1, *, cpus: float = 0.5, gpus: int = 0, **changes: Any) -> Gang:
        gang = Gang(
            job=self.job + changes.pop("suffix", ""),
            attempt=1,
            epoch=1,
            job_epoch=1,
            run="run",
            store=str(self.store.path),
            queue="default",
            pool="slurm",
            main=0,
            commands=[["bash", "-c", script]] * nodes,
            environments=[{"GREETING": "hello", "MUSTER_ON_CHILD_FAILURE": "restart"}] * nodes,
            placements=[Placement("slurm/any", tuple(map(str, range(gpus))), cpus, 64)] * nodes,
            grace=5.0,
            directory=None,
        )
        return dataclasses.replace(gang, **changes)

    def launch(self, gang: Gang) -> str:
        plan = self.engine.plan(gang)

        def launched() -> str | None:
            try:
                return self.engine.launch(plan)
            except NotYet as reason:
                if "has not answered" in str(reason):
                    return None
                raise

        handle: str = wait_for(launched, 60, "an answer")
        self.handles.append(handle)
        return handle

    def ended(self, handle: str, engine: SlurmEngine | None = None) -> list[NodeStatus]:
        def over() -> list[NodeStatus] | None:
            status = list((engine or self.engine).observe(handle))
            return status if not any(node.running for node in status) else None

        return wait_for(over, 60, "the gang's end")  # type: ignore[no-any-return]

    def lines(self, suffix: str = "") -> list[Any]:
        return LogFollower(self.run, self.job + suffix).drain()

    def log(self, suffix: str = "") -> list[str]:
        return [line.text for line in self.lines(suffix)]

    def ready(self, handle: str, nodes: int = 1, suffix: str = "") -> None:
        wait_for(lambda: self.log(suffix).count("ready") == nodes, 30, "all are ready")
        wait_for(lambda: all(node.address for node in self.engine.observe(handle)), 10, "Slurm says so")

    def state(self, handle: str) -> str:
        number = json.loads(handle)["slurm"]
        return self.cluster.run("squeue", "-h", "-t", "all", "-j", number, "-o", "%T")

    def saved(self, handle: str) -> None:
        """Wait until slurmctld has saved that the job runs: it does so every few seconds, and forgets the rest when it is killed."""
        number, state = json.loads(handle)["slurm"], self.cluster.home / "state" / "job_state"
        asked = time.time()
        self.cluster.run("scontrol", "update", f"jobid={number}", "admincomment=seen")
        wait_for(lambda: state.exists() and state.stat().st_mtime > asked, 30, "the state is saved")

    def processes(self, command: bytes) -> list[int]:
        return self.cluster.processes(command)


@pytest.fixture
def slurm_bench(slurm_cluster: SlurmCluster, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Bench]:
    """For a module to take as its own: ``bench = slurm_bench``."""
    monkeypatch.setenv("SLURM_CONF", str(slurm_cluster.conf))
    found = Bench(slurm_cluster, tmp_path)
    yield found
    for handle in found.handles:
        found.engine.stop(handle, 0.0)
    wait_for(lambda: not found.processes(b"worker.supervisor"), 20, "no supervisor is left")
    slurm_cluster.ready()
