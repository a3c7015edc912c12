"""The training's side of tracking services: a process for each that the job names, started before the worlds are built."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Mapping
from typing import Any

from shared_store.process.tether import start_tied
from shared_store.volume.node_outcomes import EX_TEMPFAIL
from worker.learning.job import Job
from worker.settings.errors import UserError

READY_SECONDS = 60.0
"""Time that a training waits for the import of a service's package [s]; then it continues without knowing whether a key exists."""
FAREWELL = {"finished": 30.0, "failed": 5.0, "stopped": 5.0}
"""Seconds that the end of a training waits for what is left to be sent."""


class Tracking:
    """The services of one training; of any other rank than the main one, none. A context manager: leaving it ends them.

    Args:
        job: The job, whose ``track`` section names the services.
        is_main: Whether this is the main rank.
    """

    def __init__(self, job: Job, *, is_main: bool) -> None:
        self.outcome = "failed"
        self._services: list[_Service] = []
        services = job.spec.get("track") or {}
        if not is_main or not services:
            return
        if not isinstance(services, dict) or not all(isinstance(each, dict | None) for each in services.values()):
            raise UserError("track: expected an object of services, such as {wandb: {project: ant}}")
        from worker.telemetry.services import SERVICES

        for name, settings in services.items():
            if settings is None:
                continue
            if name not in SERVICES:
                raise UserError(f"track: no service is called {name}; available: {', '.join(SERVICES)}")
            facts = {"job": job.id, "attempt_ranks": int(os.environ.get("WORLD_SIZE") or 1)}
            order = {"run": str(job.run.path), "epoch": job.epoch, "train": job.section, "facts": facts}
            self._services.append(_Service(name, {**order, "service": name, "settings": settings}))

    def check(self) -> None:
        """Wait until the services are found to be usable. Raises UserError where one is not."""
        deadline = time.monotonic() + READY_SECONDS
        for service in self._services:
            service.check(deadline)

    def ended(self, code: int) -> int:
        """Note the exit code with which the training ended; returns it."""
        self.outcome = {0: "finished", EX_TEMPFAIL: "stopped"}.get(code, "failed")
        return code

    def __enter__(self) -> Tracking:
        return self

    def __exit__(self, *_: object) -> None:
        for service in self._services:
            service.send({"end": self.outcome})
        deadline = time.monotonic() + FAREWELL[self.outcome]
        for service in self._services:
            service.close(deadline)


class _Service:
    """One process, and the thread that prints what it says."""

    def __init__(self, name: str, order: Mapping[str, Any]) -> None:
        self._name, self._run = name, order["run"]
        self._received, self._done = threading.Event(), False
        self._refused: str | None = None
        self._process = start_tied(
            [sys.executable, "-P", "-m", "worker.track"],
            ignoring=[signal.SIGTERM],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            start_new_session=True,
        )
        self.send(order)
        threading.Thread(target=self._listen, name=f"tracking {name}", daemon=True).start()

    def check(self, deadline: float) -> None:
        """Wait for its first word. Raises UserError where it can't be used."""
        if not self._received.wait(max(0.0, deadline - time.monotonic())):
            self._say(f"warning: it is not ready after {READY_SECONDS:.0f} s; training begins")
        if self._refused is not None:
            raise UserError(f"track.{self._name}: {self._refused}")

    def close(self, deadline: float) -> None:
        """Wait for its end, and end it."""
        try:
            self._process.wait(max(0.0, deadline - time.monotonic()))
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        if not self._done and self._refused is None:
            self._say(
                f"warning: not everything was sent; `python -m worker.track {self._run} {self._name}` sends the rest"
            )

    def _listen(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            words = json.loads(line)
            if "message" in words:
                self._say(words["message"])
            self._refused = words.get("refused", self._refused)
            self._done = self._done or "done" in words
            self._received.set()
        self._received.set()

    def _say(self, text: str) -> None:
        print(f"{self._name}: {text}", flush=True)

    def send(self, words: Mapping[str, Any]) -> None:
        """Send its order, and at last how the training ended: it sends what is left then."""
        assert self._process.stdin is not None
        with contextlib.suppress(BrokenPipeError):  # it died: its thread has noticed
            self._process.stdin.write(json.dumps(words).encode() + b"\n")
            self._process.stdin.flush()
