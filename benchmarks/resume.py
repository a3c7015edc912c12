"""Cost of saving, and time of a restart: ``python -m benchmarks.resume`` (``make bench-resume``).

Trainings go through the real command and controller on a fresh home directory; the table goes to ``resume.md``. With ``--gpus`` only the
restart is measured, with 4,096 worlds on each of two GPUs; its table goes to ``resume_gpu.md``. Kernels come from
``$WARP_CACHE_PATH`` if it is set; otherwise they are compiled first, which is not measured.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import signal
import statistics
import subprocess
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from benchmarks.load import Watch, add_option, machine, reported
from benchmarks.spine import MUSTER, REPOSITORY, Bench, seconds
from shared_store.process.processes import find_process
from shared_store.volume.checkpoints import list_checkpoints
from shared_store.volume.epoch import raise_epoch
from shared_store.volume.layout import Store
from worker.learning.saving import Saver
from worker.learning.shards import read_file

ANT = "job_specs/ant.yaml"
KILLS = 3
ON_GPUS = ("train.worlds=4096", "resources.gpus=1", "resources.memory=16GiB")
"""Changes of the spec: each node has a GPU."""
BIG = 256
"""Size of a synthetic state for the rates [MB]."""


@dataclass
class Restart:
    """Duration of each part of a restart [s]."""

    detection: float
    """SIGKILL → the controller has decided that the attempt failed."""
    stop: float
    """→ no process of the gang is left."""
    start: float
    """→ the main node's supervisor starts its rank."""
    imports: float
    """→ libraries imported, worlds built, gang connected, digests verified."""
    load: float
    """→ the checkpoint's state is in place."""
    first: float
    """→ the first resumed iteration is done and logged."""

    @property
    def total(self) -> float:
        return self.detection + self.stop + self.start + self.imports + self.load + self.first


class Restarts(Bench):
    """One controller on a fresh home, and one training on it."""

    def __init__(self, home: Path) -> None:
        if cache := os.environ.get("WARP_CACHE_PATH"):
            (home / "kernels").symlink_to(cache)
        super().__init__(home)

    def submit(self, *changes: str) -> dict[str, Any]:
        options = [part for change in changes for part in ("--set", change)]
        command = [MUSTER, "submit", ANT, "--json", *options]
        done = subprocess.run(command, env=self.env, cwd=REPOSITORY, capture_output=True, check=True)
        return self.detail(json.loads(done.stdout)["jobId"])

    def detail(self, job: str) -> dict[str, Any]:
        detail: dict[str, Any] = self.client.get(f"/api/jobs/{job}")
        return detail

    def lines(self, job: str, attempt: int) -> list[dict[str, Any]]:
        return list(self.client.logs(job, attempt=attempt, rank=0))

    def await_line(self, job: str, attempt: int, pattern: str, count: int = 1) -> dict[str, Any]:
        """The line of rank 0 that matches for the ``count``-th time."""
        while True:
            found = [line for line in self.lines(job, attempt) if re.match(pattern, line["text"])]
            if len(found) >= count:
                return found[count - 1]
            assert self.detail(job)["status"] not in ("SUCCEEDED", "FAILED"), self.detail(job)["statusReason"]
            time.sleep(0.1)

    def kill_and_wait(self, job: str, run: str, attempt: int) -> Restart:
        """SIGKILL rank 1 of ``attempt`` after a checkpoint, and wait for the first iteration of the next attempt."""
        self.await_line(job, attempt, r"checkpoint \d+")
        victim = rank_of(run, 1)
        killed = time.time()
        os.kill(victim, signal.SIGKILL)
        while self.detail(job)["attempts"][attempt - 1]["ending"] is None:
            time.sleep(0.01)
        decided = time.time()
        resumed = self.await_line(job, attempt + 1, "resumed from checkpoint")
        started = start_of(rank_of(run, 0))
        first = seconds(self.await_line(job, attempt + 1, r"iteration +\d+/")["time"])
        stopped = self.detail(job)["attempts"][attempt - 1]["stoppedAt"] / 1000
        took = re.search(r" in ([\d.]+) s", resumed["text"])
        assert took is not None
        load, loaded = float(took[1]), seconds(resumed["time"])
        return Restart(
            decided - killed, stopped - decided, started - stopped, loaded - load - started, load, first - loaded
        )

    def restarts(self, *changes: str) -> list[Restart]:
        """Kill a rank of a gang of two Ants :data:`KILLS` times; ``changes`` of its spec."""
        job = self.submit(
            "train.iterations=100000", "checkpoint.every=5", f"retry.attempts={KILLS + 1}", "train.worlds=64", *changes
        )
        found = [self.kill_and_wait(job["id"], job["run"], attempt) for attempt in range(1, KILLS + 1)]
        subprocess.run([MUSTER, "stop", job["id"]], env=self.env, check=True, capture_output=True)
        return found

    def saving(self) -> list[tuple[str, str]]:
        """Rows: cost of saves in a training of Ant that saves every 25 iterations."""
        detail = self.run(ANT, "nodes=1", "train.iterations=80", "checkpoint.every=25", "train.worlds=64")
        records = self.client.get(f"/api/runs/{detail['run']}/metrics")
        iteration = statistics.median(record["iteration_seconds"] for record in records[2:])
        stalls = [record["stall_seconds"] for record in records if record["stall_seconds"] > 0]
        assert len(stalls) == 3, stalls
        worst = max(stalls)
        checkpoint = list_checkpoints(Store(self.home / "store").run(detail["run"]))[-1]
        per_world = (checkpoint.path / "rank-0.pt").stat().st_size / checkpoint.manifest["worlds"]
        return [
            ("Ant, 1 rank × 64 worlds: one iteration (median)", f"{iteration * 1000:.0f} ms"),
            ("stall of the loop per save: each of three", ", ".join(f"{stall * 1000:.1f} ms" for stall in stalls)),
            ("worst stall as a share of an iteration (goal ≤ 1 %)", f"{worst / iteration:.2%}"),
            ("stalls as a share of all training time, `every: 25`", f"{statistics.mean(stalls) / iteration / 25:.3%}"),
            ("size of that checkpoint", f"{checkpoint.size / 1e6:.2f} MB"),
            ("of it per world", f"{per_world / 1e3:.2f} kB"),
        ]


def rank_of(run: str, rank: int) -> int:
    """Pid of a rank of a run."""
    for entry in Path("/proc").iterdir():
        try:
            trains = entry.name.isdigit() and b"worker.train" in (entry / "cmdline").read_bytes().split(b"\0")
            environment = (entry / "environ").read_bytes().split(b"\0") if trains else []
        except OSError:
            continue
        if f"MUSTER_RUN={run}".encode() in environment and f"RANK={rank}".encode() in environment:
            return int(entry.name)
    raise LookupError(f"no rank {rank} of run {run} runs")


def start_of(pid: int) -> float:
    """When a process was started (Unix time [s])."""
    process = find_process(pid)
    assert process is not None, f"process {pid} has ended"
    age = time.clock_gettime(time.CLOCK_BOOTTIME) - int(process.start) / os.sysconf("SC_CLK_TCK")
    return time.time() - age


def rates(home: Path) -> list[tuple[str, str]]:
    """Rows: a state of :data:`BIG` MB saved and loaded, without a training around it."""
    run = Store(home).open().run("big")
    raise_epoch(run, 1)
    saver = Saver(run, 1, 0, 1, 2)
    content = {"state": torch.rand(BIG * 250_000)}
    stalls, durable = [], []
    for iteration in range(1, 4):
        started = time.perf_counter()
        saver.save(iteration, {"learner.pt": saver.copy(content)}, {"worlds": 1})
        stalls.append(saver.stall)
        saver.wait()
        durable.append(time.perf_counter() - started)
    saver.close()
    (newest,) = list_checkpoints(run)[-1:]
    started = time.perf_counter()
    newest.verify()
    verified = time.perf_counter()
    read_file(newest, "learner.pt")
    read = time.perf_counter()
    return [
        (f"{BIG} MB: copy to host memory, which is all that training waits for", f"{BIG / min(stalls):,.0f} MB/s"),
        ("the same: until it is durable and committed, with its digest", f"{BIG / min(durable):,.0f} MB/s"),
        ("load: verify the digests (from the page cache)", f"{BIG / (verified - started):,.0f} MB/s"),
        ("load: read into tensors", f"{BIG / (read - verified):,.0f} MB/s"),
    ]


def measure(home: Path, gpus: bool) -> tuple[list[tuple[str, str]], list[Restart]]:
    """The rows about saving, and the restarts. With ``gpus`` there are no such rows."""
    (home / "muster").mkdir()
    bench = Restarts(home / "muster")
    changes = ON_GPUS if gpus else ()
    try:
        bench.run(ANT, "nodes=1", "train.iterations=1", "train.worlds=64", *changes)
        rows = [] if gpus else bench.saving()
        restarts = bench.restarts(*changes)
    finally:
        bench.close()
    return rows if gpus else rows + rates(home / "rates"), restarts


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_option(parser)
    parser.add_argument("--gpus", action="store_true", help="the restart on two GPUs")
    options = parser.parse_args()
    watch = Watch(options.loaded_anyway)
    with tempfile.TemporaryDirectory() as directory:
        rows, restarts = measure(Path(directory), options.gpus)
    parts = {
        "detection: SIGKILL → the controller has decided": "detection",
        "stop: → no process of the gang is left": "stop",
        "start: → the main node starts its rank": "start",
        "import: → libraries, worlds, gang, digests": "imports",
        "load: → the state is in place": "load",
        "→ the first resumed iteration is logged": "first",
        "**in all (goal < 15 s)**": "total",
    }
    table = ["| what | measured |", "|---|---|", *(f"| {name} | {value} |" for name, value in rows), ""] if rows else []
    worlds = "4,096 worlds on a GPU each" if options.gpus else "64 worlds"
    head = " | ".join(f"kill {number}" for number in range(1, len(restarts) + 1))
    gang = [f"| Ant, 2 nodes × {worlds}, warm kernels | {head} |", "|---|" + "--:|" * len(restarts)]
    for name, part in parts.items():
        gang.append(f"| {name} | " + " | ".join(f"{getattr(each, part):.2f} s" for each in restarts) + " |")
    command, name = (
        ("python -m benchmarks.resume --gpus", "resume_gpu.md") if options.gpus else ("make bench-resume", "resume.md")
    )
    intro = f"`{command}` on {machine()}. Before it: {reported([watch.start])}"
    text = "\n".join(["# Saving and resuming", "", intro, "", *table, "SIGKILL of rank 1:", "", *gang, ""])
    (REPOSITORY / "benchmarks" / name).write_text(text)
    print(text)


if __name__ == "__main__":
    main()
