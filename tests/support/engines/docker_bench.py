"""The docker engine with a home and a store of its own, and the gangs that a test starts on it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from orchestrator.domain.hosts import Placement
from orchestrator.engines.api import Gang
from orchestrator.engines.docker.engine import DockerEngine
from tests.support.engines.bench import Bench
from tests.support.engines.images import PATH, PLAIN, host_files
from tests.support.engines.sites import WAIT


class DockerBench(Bench):
    engine: DockerEngine

    def __init__(self, client: Any, home: Path) -> None:
        """``client``: of the Docker Engine, for the test."""
        self.client = client
        super().__init__(home)

    def new_engine(self) -> DockerEngine:
        return DockerEngine(self.home / "home", gpus=[])

    def gang(
        self,
        script: str = WAIT,
        nodes: int = 2,
        *,
        suffix: str = "",
        image: str = PLAIN,
        memory: int = 256,
        container: dict[str, Any] | None = None,
        **changes: Any,
    ) -> Gang:
        """``container``: more of the nodes' ``containerProperties``."""
        facts = {
            "environments": [{"PATH": PATH, "GREETING": "hello"}] * nodes,
            "placements": [Placement("here", (), 0.5, memory)] * nodes,
            "containers": [{"image": image, **host_files(), **(container or {})}] * nodes,
        }
        return super().gang(script, nodes, suffix=suffix, **{**facts, **changes})

    def left(self) -> tuple[int, int]:
        """Containers and networks of the gangs."""
        mine = {"label": "muster.gang"}
        containers = self.client.containers.list(all=True, filters=mine)
        networks = self.client.networks.list(filters=mine)
        return sum(self.job in c.labels["muster.gang"] for c in containers), sum(self.job in n.name for n in networks)

    def nothing_is_left(self) -> None:
        assert self.left() == (0, 0)
