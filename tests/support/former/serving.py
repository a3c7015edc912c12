"""A server of an older commit: its ``muster serve`` on a home, and its command."""

from __future__ import annotations

import json
import os
import subprocess
from pathlib import Path
from typing import Any

from orchestrator.client import Client
from tests.conftest import Serving
from tests.support.waiting import PATIENCE


class FormerServing(Serving):
    """``command`` is how the commit's ``muster`` is called; ``key`` is what its command and the client show, if any."""

    def __init__(self, home: Path, command: tuple[str, ...], *options: str, key: str | None = None) -> None:
        self.command, self.key = command, key
        super().__init__(home, *options)

    def start(self) -> None:
        super().start()
        self.client = Client(self.url, self.key)

    def muster(self, *arguments: str, **env: Any) -> subprocess.CompletedProcess[str]:
        """The commit's own command, in a directory that every machine has, since a job keeps its name."""
        return subprocess.run(
            [*self.command, *arguments],
            env={
                **os.environ,
                "MUSTER_HOME": str(self.home),
                **({"MUSTER_TOKEN": self.key} if self.key else {}),
                **env,
            },
            cwd="/",
            capture_output=True,
            text=True,
            timeout=300 * PATIENCE,
        )

    def answer(self, *arguments: str) -> Any:
        """What the commit's command says as JSON."""
        done = self.muster(*arguments, "--json")
        assert done.returncode == 0, f"muster {' '.join(arguments)}: {done.stdout}{done.stderr}"
        return json.loads(done.stdout)
