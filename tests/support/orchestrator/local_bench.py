"""The local engine with a home and a store of its own, and the gangs that a test starts on it."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from orchestrator.engines.base import Gang, NodeStatus, Placement
from orchestrator.engines.local import LocalEngine
from shared_store.epoch import raise_epoch, read_epoch
from shared_store.layout import Store
from shared_store.logs import LogFollower
from tests.conftest import processes_of, wait_for

WAIT = "echo ready; exec sleep 600"
JOB = "local-engine-job"
"""A name that no other test gives: gangs are found by their name on the whole machine."""


class Bench:
    """An engine with a home and a store of its own, and the gangs that it started."""

    def __init__(self, home: Path) -> None:
        self.home = home
        self.store = Store(home / "store").open()
        self.engine = LocalEngine(home / "home", cpus=8, gpus=["0", "1", "2", "3"])

    def gang(self, script: str = WAIT, nodes: int = 2, **changes: Any) -> Gang:
        facts: dict[str, Any] = {
            "job": JOB,
            "attempt": 1,
            "epoch": 1,
            "job_epoch": 1,
            "run": "run",
            "store": str(self.store.path),
            "queue": "default",
            "pool": "local",
            "main": 0,
            "commands": [["sh", "-c", script]] * nodes,
            "environments": [{}] * nodes,
            "placements": [Placement("localhost", (), 0.5, 64)] * nodes,
            "grace": 5.0,
            "directory": str(self.home),
        }
        return Gang(**{**facts, **changes})

    def launch(self, gang: Gang, engine: LocalEngine | None = None) -> str:
        engine = engine or self.engine
        run = self.store.run(gang.run)
        if read_epoch(run) < gang.epoch:  # as the controller does
            raise_epoch(run, gang.epoch)
        return engine.launch(engine.plan(gang))

    def lines(self, job: str = JOB, run: str = "run") -> list[tuple[int, str]]:
        """(node, text) of what the ranks printed."""
        found = LogFollower(self.store.run(run), job).drain()
        return [(line.node, line.text) for line in found if line.rank is not None]

    def ready(self, nodes: int = 2, job: str = JOB, run: str = "run") -> None:
        wait_for(lambda: [text for _, text in self.lines(job, run)].count("ready") == nodes, 10, f"{nodes} nodes")

    def wait_for_end(self, handle: str, engine: LocalEngine | None = None) -> Sequence[NodeStatus]:
        def ended() -> Sequence[NodeStatus] | None:
            status = (engine or self.engine).observe(handle)
            return None if any(node.running for node in status) else status

        found: Sequence[NodeStatus] = wait_for(ended, 15, "the end of the gang")
        return found

    def environments(self, nodes: int) -> list[dict[str, str]]:
        """What a gang that prints its environment as JSON printed, by node index."""
        found: dict[int, dict[str, str]] = {}
        for node, text in self.lines():
            found[node] = json.loads(text)
        return [found[index] for index in range(nodes)]

    def processes(self) -> list[int]:
        return processes_of(self.store.path)
