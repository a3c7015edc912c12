"""Hours of real jobs on one controller: ``python -m benchmarks.soak [--hours 2] [--every 300]`` prints a table for ``benchmarks/soak.md``.

``muster serve`` with the engine ``local`` and a rule of retention. Gangs of two nodes, jobs that fail and are tried again, arrays and jobs that are
stopped follow one another, a few at a time; some followers read each log. Every few minutes: the server's memory, threads and descriptors, the
rows of its database and the files of its store. A leak shows as a column that grows.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import sqlite3
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.log_follow import MUSTER
from orchestrator.client import Client
from orchestrator.domain.errors import ApiError

RETENTION = "10m"
AT_ONCE = 8
"""Jobs that have not ended, at most; more are submitted when fewer are left."""
FOLLOWERS = 4
OPEN = ["SUBMITTED", "PENDING", "RUNNABLE", "STARTING", "RUNNING"]
TABLES = ("jobs", "attempts", "nodes", "runs", "job_definitions", "dependencies", "run_uses")


@dataclass
class Sample:
    """The state at a moment."""

    hours: float
    ended: int
    """Jobs that were submitted and have ended."""
    memory: float
    """MiB."""
    threads: int
    descriptors: int
    rows: int
    database: float
    """MiB, with its log."""
    files: int
    processor: float
    """Share of a core since the last sample."""

    def row(self) -> str:
        return (
            f"| {self.hours:.2f} | {self.ended:,} | {self.memory:.1f} | {self.threads} | {self.descriptors} | {self.rows:,} "
            f"| {self.database:.1f} | {self.files:,} | {100 * self.processor:.0f} % |"
        )


HEADER = """| hours | jobs ended | memory [MiB] | threads | descriptors | rows | database [MiB] | files of the store | of a core |
|---|---|---|---|---|---|---|---|---|"""


class Load:
    """Submits jobs until it is stopped."""

    def __init__(self, url: str) -> None:
        self.client = Client(url)
        self.ending = threading.Event()
        self.submitted = 0
        self._number = 0
        self._newest = ""
        for name, nodes, script, retry in (
            ("pair", 2, "echo begun; sleep 1; echo done", 1),
            ("fails", 1, "echo no; exit 3", 2),
            ("child", 1, "echo $AWS_BATCH_JOB_ARRAY_INDEX", 1),
            ("stopped", 1, "while true; do echo line; sleep 0.1; done", 1),
        ):
            self._register(name, nodes, script, retry)

    def _register(self, name: str, nodes: int, script: str, attempts: int) -> None:
        container: dict[str, Any] = {
            "image": "any",
            "command": ["sh", "-c", script],
            "resourceRequirements": [{"type": "VCPU", "value": "1"}, {"type": "MEMORY", "value": "16"}],
        }
        ranges = [{"targetNodes": "0:", "container": container}]
        what: dict[str, Any] = {"type": "container", "containerProperties": container}
        if nodes > 1:
            properties = {"numNodes": nodes, "mainNode": 0, "nodeRangeProperties": ranges}
            what = {"type": "multinode", "nodeProperties": properties}
        self.client.batch("RegisterJobDefinition", jobDefinitionName=name, retryStrategy={"attempts": attempts}, **what)

    def submit(self, name: str, **more: Any) -> str:
        self._number += 1
        answer = self.client.batch(
            "SubmitJob", jobName=f"{name}-{self._number}", jobQueue="default", jobDefinition=name, **more
        )
        self.submitted += 1 + int(more.get("arrayProperties", {}).get("size", 0))
        return str(answer["jobId"])

    def open(self) -> int:
        """Number of jobs that have not ended."""
        return int(self.client.get("/api/jobs", status=OPEN, max=1)["total"])

    def stop_all(self) -> None:
        """End what has not ended: nodes outlive their controller."""
        while jobs := self.client.get("/api/jobs", status=OPEN, max=100)["jobs"]:
            for job in jobs:
                self.client.batch("TerminateJob", jobId=job["id"], reason="the soak is over")
            time.sleep(1.0)

    def run(self) -> None:
        stopping: list[str] = []
        while not self.ending.is_set():
            with contextlib.suppress(ApiError):
                if self.open() >= AT_ONCE:
                    self.ending.wait(0.2)
                    continue
                match self._number % 8:
                    case 0:
                        self.submit("child", arrayProperties={"size": 3})
                    case 2:
                        self.submit("fails")
                    case 4:
                        stopping.append(self.submit("stopped"))
                    case _:
                        self._newest = self.submit("pair")
                if len(stopping) > 2:
                    self.client.batch("TerminateJob", jobId=stopping.pop(0), reason="enough")

    def follow(self) -> None:
        """Read the logs of some jobs to their ends."""
        client = Client(self.client.url)
        while not self.ending.is_set():
            with contextlib.suppress(ApiError):
                if job := self._newest:
                    for _ in client.logs(job, follow=True):
                        pass
            self.ending.wait(1.0)


def sample(process: int, home: Path, began: float, ended: int, since: tuple[float, float]) -> Sample:
    status = dict(
        line.split(":", 1) for line in Path(f"/proc/{process}/status").read_text().splitlines() if ":" in line
    )
    database = home / "muster.db"
    with contextlib.closing(sqlite3.connect(f"file:{database}?mode=ro", uri=True, timeout=30)) as connection:
        rows = sum(connection.execute(f"SELECT count(*) FROM {table}").fetchone()[0] for table in TABLES)
    size = sum(each.stat().st_size for each in home.glob("muster.db*"))
    files = sum(len(names) for _, _, names in os.walk(home / "store"))
    now, used = time.monotonic(), processor_time(process)
    share = (used - since[1]) / max(1e-9, now - since[0])
    descriptors = len(os.listdir(f"/proc/{process}/fd"))
    memory = int(status["VmRSS"].split()[0]) / 1024
    return Sample(
        (now - began) / 3600, ended, memory, int(status["Threads"]), descriptors, rows, size / 2**20, files, share
    )


def processor_time(process: int) -> float:
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


@contextlib.contextmanager
def server(home: Path) -> Iterator[tuple[int, str]]:
    """A server of its own process: its id, and its URL."""
    environment = {**os.environ, "MUSTER_HOME": str(home)}
    for name in ("MUSTER_URL", "MUSTER_TOKEN"):
        environment.pop(name, None)
    command = [MUSTER, "serve", "--port", "0", "--cpus", "32", "--retention", RETENTION]
    with open(home / "server.txt", "wb") as output:
        process = subprocess.Popen(command, env=environment, stdout=output, stderr=output)
        try:
            while not (found := list(home.glob("controller.json"))) and process.poll() is None:
                time.sleep(0.1)
            assert process.poll() is None, (home / "server.txt").read_text()
            yield process.pid, json.loads(found[0].read_text())["url"]
        finally:
            process.terminate()
            process.wait(60)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--hours", type=float, default=2.0, help="how long")
    parser.add_argument("--every", type=float, default=300.0, help="seconds between two samples")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder, server(Path(folder)) as (process, url):
        home, load, began = Path(folder), Load(url), time.monotonic()
        threads = [threading.Thread(target=load.run, daemon=True)]
        threads += [threading.Thread(target=load.follow, daemon=True) for _ in range(FOLLOWERS)]
        for thread in threads:
            thread.start()
        print(HEADER, flush=True)
        since = began, processor_time(process)
        while time.monotonic() - began < 3600 * options.hours:
            time.sleep(options.every)
            found = sample(process, home, began, load.submitted - load.open(), since)
            since = time.monotonic(), processor_time(process)
            print(found.row(), flush=True)
        load.ending.set()
        for thread in threads:
            thread.join(60)
        load.stop_all()
        lines = [
            line for line in (home / "server.txt").read_text().splitlines() if "Traceback" in line or "ERROR" in line
        ]
        print(f"\n{len(lines)} errors in the server's log{': ' + lines[0] if lines else ''}")
    sys.exit(bool(lines))


if __name__ == "__main__":
    main()
