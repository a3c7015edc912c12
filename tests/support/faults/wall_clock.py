"""A wall clock that jumps under a controller and all that it starts: one class of a torture."""

from __future__ import annotations

import random
import shutil
import struct
import subprocess
import time
from collections import Counter
from pathlib import Path
from typing import Any

import pytest

from orchestrator.client import Client
from tests.conftest import MAIN_LAST, submit_gang
from tests.support.faults.home import Home
from tests.support.orchestrator.jobs import await_status
from tests.support.processes import end_all

JUMPS = (7200.0, -86400.0, 30.0, -5.0, 90 * 86400.0)
"""Seconds, to choose from."""
LINES = 60
SCRIPT = f"""
import time
for number in range({LINES}):
    print(number, flush=True)
    time.sleep(0.1)
{MAIN_LAST}"""


class WallClock:
    """The wall clock of processes that are started with :attr:`env`; their monotonic clocks are left alone."""

    def __init__(self, directory: Path) -> None:
        compiler = shutil.which("cc")
        if compiler is None:
            pytest.skip("no C compiler here to build what moves the wall clock")
        directory.mkdir(parents=True, exist_ok=True)
        library, self._offset = directory / "wall_clock.so", directory / "offset"
        source = Path(__file__).with_name("wall_clock.c")
        subprocess.run([compiler, "-O2", "-shared", "-fPIC", "-o", library, source, "-ldl"], check=True)
        self.set(0.0)
        self.env = {"LD_PRELOAD": str(library), "WALL_CLOCK_OFFSET": str(self._offset)}

    def set(self, seconds: float) -> None:
        """The clock is that many seconds ahead of the machine's from now on."""
        with open(self._offset, "r+b" if self._offset.exists() else "wb") as file:
            file.write(struct.pack("q", int(seconds * 1e9)))


def wall_clock_round(directory: Path, seed: int) -> tuple[Counter[str], list[str]]:
    """A job with a time limit of an hour runs while the clock jumps, the controller perhaps restarts; nothing may come of it."""
    rng = random.Random(seed)
    clock = WallClock(directory / "clock")
    home = Home(directory / "home", **clock.env)
    done: Counter[str] = Counter()
    wrong: list[str] = []
    try:
        home.serve()
        with Client(home.url) as client:
            job = submit_gang(client, SCRIPT, 2, name="steady", timeout=3600, attempts=2)
            await_status(client, job, "RUNNING")
        for _ in range(rng.choice((1, 2, 3))):
            time.sleep(rng.uniform(0.3, 1.5))
            clock.set(rng.choice(JUMPS))
            done["jumps"] += 1
            if rng.random() < 0.3:
                home.strike(9)
                home.serve()
                done["controllers killed"] += 1
        with Client(home.url) as client:
            wrong += _check(await_status(client, job, "SUCCEEDED", "FAILED"), list(client.logs(job)))
        done["jobs"] += 1
    finally:
        home.close()
        end_all(home.path)
    return done, wrong


def _check(detail: dict[str, Any], lines: list[dict[str, Any]]) -> list[str]:
    wrong = []
    attempts = detail["attempts"]
    if detail["status"] != "SUCCEEDED" or len(attempts) != 1:
        wrong.append(f"the job is {detail['status']} after {len(attempts)} attempts: {detail.get('statusReason')}")
    for node in (0, 1):
        numbers = [int(each["text"]) for each in lines if each["node"] == node and each["text"].isdigit()]
        if numbers != list(range(LINES)):
            wrong.append(f"the log of node {node} is not in order: {numbers}")
    return wrong
