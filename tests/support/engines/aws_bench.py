"""A controller's home and an aws-batch engine on a second Muster, which plays AWS."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from orchestrator.engines.aws_batch import AwsBatchEngine
from orchestrator.engines.aws_config import AwsConfig, save_config
from orchestrator.engines.base import Gang, NodeStatus, NotYet, Placement
from shared_store.epoch import raise_epoch, read_epoch
from shared_store.layout import Store
from shared_store.logs import LogFollower
from shared_store.outcomes import Outcome, read_outcome
from tests.conftest import Serving, processes_of, wait_for
from tests.support.engines.sites import WAIT

JOB = "6f1d0c5e-0000-4000-8000-00000000aaaa"


class Bench:
    """A controller's home and store, the volume that the nodes have, and the engine between them."""

    def __init__(self, aws: Serving, home: Path, **config: Any) -> None:
        self.aws, self.home = aws, home
        self.volume = Store(home / "efs").open()
        self.store = self.volume if config.get("store_is_shared") else Store(home / "store").open()
        settings = {"store": str(self.volume.path), "poll": 0.1, "quiet": 1.0, **config}
        told = {"region": "us-east-1", "job_queue": "default", "image": "muster", "endpoint_url": aws.url, **settings}
        save_config(home, AwsConfig(**told))
        self.engine = AwsBatchEngine(home)
        self.handles: list[str] = []
        self.run = self.store.run("run")

    def gang(
        self, script: str = WAIT, nodes: int = 2, *, attempt: int = 1, native: bool = True, **changes: Any
    ) -> Gang:
        environment = {"GREETING": "hello", **({"MUSTER_ON_CHILD_FAILURE": "restart"} if native else {})}
        self.run.create({"run": "run"})
        if read_epoch(self.run) < attempt:
            raise_epoch(self.run, attempt)
        values: dict[str, Any] = {
            "job": JOB,
            "attempt": attempt,
            "epoch": attempt,
            "job_epoch": 1,
            "run": "run",
            "store": str(self.store.path),
            "queue": "default",
            "pool": "aws",
            "main": 0,
            "commands": [["sh", "-c", script]] * nodes,
            "environments": [environment] * nodes,
            "placements": [Placement("aws-batch/default", (), 0.5, 64)] * nodes,
            "grace": 5.0,
            "directory": "/no/such/directory",
            "containers": [{"image": "muster" if native else "busybox"}] * nodes,
            "title": self.home.name.replace("_", "-"),
        }
        return Gang(**{**values, **changes})

    def launch(self, gang: Gang) -> str:
        def launched() -> str | None:
            try:
                return self.engine.launch(self.engine.plan(gang))
            except NotYet:
                return None

        handle: str = wait_for(launched, 10, "the launch")
        self.handles.append(handle)
        return handle

    def ended(self, handle: str, engine: AwsBatchEngine | None = None) -> list[NodeStatus]:
        def over() -> list[NodeStatus] | None:
            status = list((engine or self.engine).observe(handle))
            return status if not any(node.running for node in status) else None

        found: list[NodeStatus] = wait_for(over, 40, "the gang's end")
        return found

    def log(self, attempt: int = 1) -> list[str]:
        lines = LogFollower(self.run, JOB).drain()
        return [line.text for line in lines if line.attempt == attempt and line.rank is not None]

    def ready(self, count: int, attempt: int = 1) -> None:
        def there() -> bool:
            self.engine.observe(self.handles[-1])  # a controller looks all the time
            return self.log(attempt).count("ready") == count

        wait_for(there, 30, f"{count} ready nodes")

    def outcome(self, node: int, attempt: int = 1) -> Outcome:
        found = read_outcome(self.run, JOB, attempt, node)
        assert found is not None, (node, self.log(attempt))
        return found

    def processes(self) -> list[int]:
        """Of all nodes: those that "AWS" runs, and those that see the volume."""
        return [*processes_of(self.aws.home), *processes_of(self.volume.path)]


def close(bench: Bench) -> None:
    for handle in bench.handles:
        bench.engine.stop(handle, 0.0)
    assert bench.processes() == []
