"""The aws-batch engine on a second Muster, which plays AWS, and the gangs that a test starts on it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from orchestrator.domain.hosts import Placement
from orchestrator.engines.api import Gang
from orchestrator.engines.aws_batch.config import AwsConfig, save_config
from orchestrator.engines.aws_batch.engine import AwsBatchEngine
from shared_store.layout import Store
from tests.conftest import Serving
from tests.support.engines.bench import Bench
from tests.support.engines.sites import WAIT
from tests.support.processes import processes_of


class AwsBench(Bench):
    """A controller's home and store, the volume that the nodes have, and the engine between them."""

    engine: AwsBatchEngine
    asks_again = ("AWS Batch",)

    def __init__(self, aws: Serving, home: Path, **config: Any) -> None:
        self.aws = aws
        self.volume = Store(home / "efs").open()
        settings = {"store": str(self.volume.path), "poll": 0.1, "quiet": 1.0, **config}
        told = {"region": "us-east-1", "job_queue": "default", "image": "muster", "endpoint_url": aws.url, **settings}
        save_config(home, AwsConfig(**told))
        super().__init__(home, self.volume if config.get("store_is_shared") else None)

    def new_engine(self) -> AwsBatchEngine:
        return AwsBatchEngine(self.home)

    def gang(
        self, script: str = WAIT, nodes: int = 2, *, suffix: str = "", native: bool = True, **changes: Any
    ) -> Gang:
        """``native``: with Muster in the image."""
        environment = {"GREETING": "hello", **({"MUSTER_ON_CHILD_FAILURE": "restart"} if native else {})}
        facts = {
            "environments": [environment] * nodes,
            "placements": [Placement("aws-batch/default", (), 0.5, 64)] * nodes,
            "directory": "/no/such/directory",
            "is_native": native,
            "containers": [{"image": "muster" if native else "busybox"}] * nodes,
            "title": self.home.name.replace("_", "-"),
        }
        return super().gang(script, nodes, suffix=suffix, **{**facts, **changes})

    def processes(self) -> list[int]:
        """Of all nodes: those that "AWS" runs, and those that see the volume."""
        return [*processes_of(self.aws.home), *processes_of(self.volume.path)]
