"""The local engine with a home and a store of its own, and the gangs that a test starts on it."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

from orchestrator.engines.api import Gang
from orchestrator.engines.local.engine import LocalEngine
from tests.support.engines.bench import Bench
from tests.support.engines.sites import WAIT
from tests.support.processes import end_all

_JOB = f"local-engine-job-{os.getpid()}"
"""One for all tests of this process and no other, since the engine finds gangs by their names on the whole machine."""


class LocalBench(Bench):
    engine: LocalEngine

    def __init__(self, home: Path) -> None:
        super().__init__(home, job=_JOB)

    def new_engine(self) -> LocalEngine:
        return LocalEngine(self.home / "home", cpus=8, gpus=["0", "1", "2", "3"])

    def gang(self, script: str = WAIT, nodes: int = 2, *, suffix: str = "", **changes: Any) -> Gang:
        return super().gang(script, nodes, suffix=suffix, **{"directory": str(self.home), **changes})

    def printed(self, attempt: int = 1) -> list[tuple[int, str]]:
        """(node, text) of what the ranks printed."""
        return [(line.node, line.text) for line in self.lines(attempt) if line.rank is not None]

    def environments(self, gang: Gang) -> list[dict[str, str]]:
        """What a gang that prints its environment as JSON printed, by node index."""
        found: dict[int, dict[str, str]] = {node: json.loads(text) for node, text in self.printed(gang.attempt)}
        return [found[index] for index in range(len(gang.commands))]

    def close(self) -> None:
        """End all that is left, without the engine: a test may have broken it."""
        end_all(self.store.path)
