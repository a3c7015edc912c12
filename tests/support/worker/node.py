"""One node of a gang for the supervisor's tests: its contract, its store, and a real supervisor process."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from shared_store.contract.node import NodeContract
from shared_store.volume.epoch import raise_epoch, read_epoch
from shared_store.volume.layout import Run, Store
from shared_store.volume.log_view import LogView
from shared_store.volume.node_outcomes import Outcome, read_outcome
from tests.support.waiting import PATIENCE, wait_for

ENVIRONMENT = {
    name: value
    for name, value in os.environ.items()
    if not name.startswith(("MUSTER_", "AWS_", "OMP_", "NCCL_", "GLOO_", "TORCH", "PYTHONUN"))
}


PROGRAM = ("-P", "-m", "worker.supervisor")


class Node:
    """One node of a gang: its contract, its store, and the supervisor process."""

    def __init__(self, home: Path, **contract: Any) -> None:
        facts = {
            "job": "job",
            "attempt": 1,
            "node_index": 0,
            "node_count": 1,
            "main_index": 0,
            "master_address": "127.0.0.1",
            "master_port": 29500,
            "run": "run",
            "store": str(home),
            "epoch": 1,
            "job_epoch": 1,
            "grace": 10.0,
        }
        self.contract = NodeContract(**{**facts, **contract})
        self.run: Run = Store(home).open().run("run")
        if read_epoch(self.run) < self.contract.epoch:
            raise_epoch(self.run, self.contract.epoch)
        self.environment = {**ENVIRONMENT, **self.contract.to_env()}
        self.stderr = home / "stderr"

    def start(self, *command: str, program: tuple[str, ...] = PROGRAM, **env: str) -> None:
        with open(self.stderr, "wb") as stderr:
            self.process = subprocess.Popen(
                [sys.executable, *program, "--", *command],
                env={**self.environment, **env},
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=stderr,
            )

    def wait(self, timeout: float = 20 * PATIENCE) -> int:
        return self.process.wait(timeout)

    def call(self, *command: str, **env: str) -> int:
        """Start ``command`` and wait for the node's end; returns its exit code."""
        self.start(*command, program=PROGRAM, **env)
        return self.wait()

    def shell(self, script: str, **env: str) -> int:
        return self.call("sh", "-c", script, **env)

    def python(self, script: str, **env: str) -> int:
        return self.call(sys.executable, "-c", script, **env)

    def lines(self) -> list[tuple[int | None, str, str]]:
        """(rank, stream, text) of every line in the node's log."""
        return [(line.rank, line.stream, line.text) for line in LogView.of(self.run, "job").drain()]

    def output(self) -> list[str]:
        """What the ranks printed."""
        return [text for rank, _, text in self.lines() if rank is not None]

    def wait_for_output(self, text: str) -> None:
        wait_for(lambda: text in self.output(), 10, f"{text!r} in the log")

    @property
    def outcome(self) -> Outcome | None:
        return read_outcome(self.run, "job", self.contract.attempt, self.contract.node_index)

    def ended(self) -> Outcome:
        outcome = self.outcome
        assert outcome, self.stderr.read_text()
        return outcome


Nodes = Callable[..., Node]


def node_contract(endpoint: str | None, token: str | None, index: int = 0, job: str = "j") -> NodeContract:
    return NodeContract(job, 1, index, 2, 0, "127.0.0.1", 1, "r", "/", 1, 1, bus=endpoint, bus_token=token)
