"""How fast ``/healthz`` answers under load: ``python -m benchmarks.health``.

Loads are added one after the other, and stay: 16 requests whose read of the store hangs (the user must be root: ``fanotify``), 120 clients
that follow a long log and never read, and 12 that check a job YAML again and again, with a reward function that is refused for its
size, then with one that is translated. Prints a Markdown table. The bound is 100 ms.
"""

from __future__ import annotations

import os
import platform
import socket
import subprocess
import tempfile
import threading
import time
from collections import Counter
from contextlib import ExitStack, closing
from pathlib import Path
from statistics import median
from typing import Any

import httpx

from benchmarks.log_follow import MUSTER, finish, submit
from orchestrator.client import Client
from shared_store.volume.layout import Store
from tests.support.console.visitor import Visitor
from tests.support.faults.stalled import stalled

READS, FOLLOWERS, CHECKS = 16, 120, 12
SECONDS, PAUSE = 6.0, 0.05
"""For which ``/healthz`` is asked under each load, and between two of these requests."""
COMPARISONS = {"117 KiB": 60_000, "18 KiB": 9_000}
"""Of the reward function in a checked YAML, by its size."""
_FLOOD = "for i in range(400_000): print('line', i, 'of the log of a program that prints much')"


def ask(url: str, load: str) -> None:
    """Print a row of the table."""
    took, over = [], time.monotonic() + SECONDS
    with httpx.Client(base_url=url, timeout=60) as client:
        while time.monotonic() < over:
            began = time.monotonic()
            client.get("/healthz").raise_for_status()
            took.append((time.monotonic() - began) * 1000)
            time.sleep(PAUSE)
    took.sort()
    print(f"| {load} | {len(took)} | {median(took):.1f} | {took[-2]:.1f} | {took[-1]:.1f} |", flush=True)


def follow(url: str, job: str) -> socket.socket:
    """A client that asks for the log of a job and never reads."""
    host, port = url.removeprefix("http://").split(":")
    client = socket.create_connection((host, int(port)))
    client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    client.sendall(f"GET /api/jobs/{job}/logs?follow=true HTTP/1.1\r\nHost: {host}\r\n\r\n".encode())
    return client


def read(url: str, job: str) -> None:
    with httpx.Client(timeout=120) as client:
        client.get(f"{url}/api/jobs/{job}")


class Checks:
    """Clients that check one YAML repeatedly, as the submission wizard does."""

    def __init__(self, url: str, comparisons: int) -> None:
        self._visitor = Visitor(url)
        token = self._visitor.page("/").form_token
        code = ("def reward_function(params):", "    return 1.0", "x = 1" + "<1" * comparisons)
        text = "".join(f"        {line}\n" for line in code)
        head = "name: a\ntrain:\n  task: Racer\n  config:\n    reward_function:\n      file: r.py\n      text: |\n"
        self._form: dict[str, Any] = {"form_token": token, "yaml": head + text, "whole": "yes"}
        self._over, self.statuses = threading.Event(), Counter[int]()
        self._threads = [threading.Thread(target=self._check, daemon=True) for _ in range(CHECKS)]
        for thread in self._threads:
            thread.start()

    def _check(self) -> None:
        while not self._over.is_set():
            self.statuses[self._visitor.http.post("/submit/check", data=self._form).status_code] += 1

    def close(self) -> None:
        self._over.set()
        for thread in self._threads:
            thread.join()


def measure(url: str, home: Path) -> None:
    """Print the table's rows."""
    with ExitStack() as loads, Client(url) as client:
        loud, quiet = submit(client, "loud", _FLOOD, 1), submit(client, "quiet", "pass", 1)
        for job in (loud, quiet):
            finish(client, job)
        checkpoints = Store(home / "store").run(client.get(f"/api/jobs/{quiet}")["run"]).checkpoints
        checkpoints.mkdir(exist_ok=True)
        ask(url, "nothing")
        loads.enter_context(stalled(checkpoints))
        for _ in range(READS):
            threading.Thread(target=read, args=(url, quiet), daemon=True).start()
        time.sleep(1)
        ask(url, f"{READS} reads hang")
        for _ in range(FOLLOWERS):
            loads.enter_context(follow(url, loud))
        ask(url, f"and {FOLLOWERS} followers that do not read, from the moment in which they begin")
        ask(url, "the same, later")
        for size, comparisons in COMPARISONS.items():
            with closing(Checks(url, comparisons)) as checks:
                ask(url, f"and {CHECKS} checks of {size} at once")
            answers = ", ".join(f"{status} × {count}" for status, count in sorted(checks.statuses.items()))
            print(f"| answers to these checks: {answers} | | | | |", flush=True)


def main() -> None:
    print(f"{os.cpu_count()} cores ({platform.machine()}), load {os.getloadavg()[0]:.1f}\n")
    print("| load | requests of /healthz | median ms | second greatest ms | greatest ms |\n|---|--:|--:|--:|--:|")
    with tempfile.TemporaryDirectory() as folder:
        home = Path(folder) / "home"
        env = {**os.environ, "MUSTER_HOME": str(home)}
        server = subprocess.Popen([MUSTER, "serve", "--port", "0"], env=env, stdout=subprocess.PIPE, text=True)
        try:
            assert server.stdout is not None
            measure(server.stdout.readline().split()[2], home)
        finally:
            server.kill()
            server.wait()


if __name__ == "__main__":
    main()
