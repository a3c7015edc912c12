"""Serving a home whose keys a test has: by the ``muster serve`` of today, or of an older commit."""

from __future__ import annotations

import json
import os
import subprocess
from pathlib import Path
from typing import Any

from orchestrator.client import Client
from tests.conftest import Serving
from tests.support.waiting import PATIENCE


class KeyServing(Serving):
    """Today's; its client and its command show ``key``, if there is one."""

    def __init__(self, home: Path, *options: str, key: str | None = None) -> None:
        self.key = key
        super().__init__(home, *options)

    def start(self) -> None:
        super().start()
        self.client = Client(self.url, self.key)

    def muster(self, *arguments: str, **env: Any) -> subprocess.CompletedProcess[str]:
        return super().muster(*arguments, **(env if self.key is None else {"MUSTER_TOKEN": self.key, **env}))

    def answer(self, *arguments: str) -> Any:
        """What a command says as JSON."""
        done = self.muster(*arguments, "--json")
        assert done.returncode == 0, f"muster {' '.join(arguments)}: {done.stdout}{done.stderr}"
        return json.loads(done.stdout)


def call_former(command: tuple[str, ...], home: Path, *arguments: str, **env: str) -> subprocess.CompletedProcess[str]:
    """An older commit's ``muster``, in a directory that every machine has, since a job keeps its name."""
    return subprocess.run(
        [*command, *arguments],
        env={**os.environ, "MUSTER_HOME": str(home), **env},
        cwd="/",
        capture_output=True,
        text=True,
        timeout=300 * PATIENCE,
    )


def create_key(command: tuple[str, ...], home: Path, name: str, *rights: str) -> str:
    """Have an older commit make an access key; returns it as clients show it."""
    done = call_former(command, home, "keys", "create", name, *rights, "--json")
    assert done.returncode == 0, done.stderr
    key = json.loads(done.stdout)
    return f"{key['accessKeyId']}:{key['secretAccessKey']}"


class FormerServing(KeyServing):
    """An older commit's: ``command`` is how its ``muster`` is called."""

    def __init__(self, home: Path, command: tuple[str, ...], *options: str, key: str | None = None) -> None:
        self.command = command
        super().__init__(home, *options, key=key)

    def muster(self, *arguments: str, **env: Any) -> subprocess.CompletedProcess[str]:
        return call_former(
            self.command, self.home, *arguments, **({"MUSTER_TOKEN": self.key} if self.key else {}), **env
        )
