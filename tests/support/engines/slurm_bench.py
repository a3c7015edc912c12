"""The Slurm engine on a cluster, a store, and the gangs that a test submits."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from orchestrator.domain.hosts import Placement
from orchestrator.engines.api import Gang, Handle
from orchestrator.engines.slurm.engine import SlurmEngine
from orchestrator.engines.toolkit.statuses import status_of
from tests.support.engines.bench import Bench
from tests.support.engines.sites import WAIT
from tests.support.engines.slurm_cluster import SlurmCluster
from tests.support.waiting import wait_for


class SlurmBench(Bench):
    engine: SlurmEngine
    asks_again = ("has not answered",)

    def __init__(self, cluster: SlurmCluster, home: Path) -> None:
        self.cluster = cluster
        super().__init__(home)

    def new_engine(self) -> SlurmEngine:
        return SlurmEngine()

    def gang(
        self,
        script: str = WAIT,
        nodes: int = 1,
        *,
        suffix: str = "",
        cpus: float = 0.5,
        gpus: int = 0,
        **changes: Any,
    ) -> Gang:
        facts = {
            "commands": [["bash", "-c", script]] * nodes,
            "environments": [{"GREETING": "hello", "MUSTER_ON_CHILD_FAILURE": "restart"}] * nodes,
            "placements": [Placement("slurm/any", tuple(map(str, range(gpus))), cpus, 64)] * nodes,
        }
        return super().gang(script, nodes, suffix=suffix, **{**facts, **changes})

    def ready(self, gang: Gang) -> Handle:
        handle = super().ready(gang)
        wait_for(lambda: all(node.address for node in status_of(self.engine, handle)), 10, "Slurm says so")
        return handle

    def state(self, handle: Handle) -> str:
        number = handle.facts["slurm"]
        return self.cluster.run("squeue", "-h", "-t", "all", "-j", number, "-o", "%T")

    def saved(self, handle: Handle) -> None:
        """Wait until slurmctld has saved that the job runs: it does so every few seconds, and forgets the rest when it is killed."""
        number, state = handle.facts["slurm"], self.cluster.home / "state" / "job_state"
        requested = time.time()
        self.cluster.run("scontrol", "update", f"jobid={number}", "admincomment=seen")
        wait_for(lambda: state.exists() and state.stat().st_mtime > requested, 30, "the state is saved")

    def processes(self, text: str = "worker.supervisor") -> list[int]:
        """Pids of the cluster's processes with ``text`` in their command line."""
        return self.cluster.processes(text)

    def close(self) -> None:
        try:
            for handle in self.handles:
                self.engine.stop(handle, 0.0)
            wait_for(lambda: not self.processes(), 20, "no supervisor is left")
            self.cluster.ready()
        except Exception as error:
            shown = self.cluster.shown()
            self.cluster.begin_anew()
            raise AssertionError(f"{error}; {shown}") from error


@pytest.fixture
def slurm_bench(slurm_cluster: SlurmCluster, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[SlurmBench]:
    """For a module to take as its own: ``bench = slurm_bench``."""
    monkeypatch.setenv("SLURM_CONF", str(slurm_cluster.conf))
    found = SlurmBench(slurm_cluster, tmp_path)
    yield found
    found.close()
