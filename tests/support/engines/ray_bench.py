"""The Ray engine on a cluster, with a home and a store of its own, and the gangs that a test starts on it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from orchestrator.domain.hosts import Placement
from orchestrator.engines.api import Gang, Handle
from orchestrator.engines.ray.engine import RayEngine
from orchestrator.engines.toolkit.statuses import status_of
from tests.support.engines.bench import Bench
from tests.support.engines.ray_cluster import RayCluster
from tests.support.engines.sites import WAIT
from tests.support.processes import processes_of
from tests.support.waiting import wait_for


class RayBench(Bench):
    engine: RayEngine

    def __init__(self, cluster: RayCluster, home: Path) -> None:
        self.cluster = cluster
        super().__init__(home)

    def new_engine(self) -> RayEngine:
        return RayEngine(self.home / "home")

    def gang(
        self,
        script: str = WAIT,
        nodes: int = 3,
        *,
        suffix: str = "",
        hosts: tuple[str, ...] = (),
        cpus: float = 1.0,
        gpus: tuple[str, ...] = (),
        **changes: Any,
    ) -> Gang:
        """``hosts``: where its nodes go; ``n1`` and those that follow, as many as ``nodes`` says, by default."""
        hosts = hosts or tuple(f"n{number}" for number in range(1, nodes + 1))
        placements = [Placement(f"ray/{host}", gpus, cpus, 256) for host in hosts]
        return super().gang(script, len(hosts), suffix=suffix, **{"placements": placements, **changes})

    def stopped_existing(self, handle: Handle) -> list[int | None]:
        """Exit codes of a gang that lost its third node, where that may go on until it ends itself."""
        self.engine.stop(handle, 5.0)
        return [node.exit_code for node in status_of(self.engine, handle)][:2]

    def driver(self) -> int:
        [pid] = processes_of(self.home / "home")
        return pid

    def close(self) -> None:
        super().close()
        self.engine._let_go("")
        self.engine.close()
        wait_for(lambda: not processes_of(self.home), 30, "the drivers leave")
