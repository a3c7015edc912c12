"""Starts real ranks for the learning tests: ``python -m tests.support.worker.ranks BODY`` runs function BODY of this module or of ``module:BODY``."""

from __future__ import annotations

import importlib
import json
import os
import socket
import subprocess
import sys
from pathlib import Path
from typing import Any

from tests.support.waiting import PATIENCE

ROOT = Path(__file__).resolve().parents[3]


def free_port() -> int:
    """A port that nobody has at any address of this machine."""
    with socket.socket() as probe:
        probe.bind(("", 0))
        return int(probe.getsockname()[1])


def placement(rank: int = 0, ranks: int = 1, port: int = 0) -> dict[str, str]:
    """What the supervisor tells a rank of its gang, all of which is on this machine's processor."""
    return {
        **{"RANK": str(rank), "WORLD_SIZE": str(ranks), "LOCAL_RANK": "0", "LOCAL_WORLD_SIZE": "1"},
        **{"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port or free_port()), "OMP_NUM_THREADS": "1"},
        **{"GLOO_SOCKET_IFNAME": "lo", "CUDA_VISIBLE_DEVICES": ""},
    }


def start_rank(body: str, rank: int, ranks: int, port: int, env: dict[str, str]) -> subprocess.Popen[str]:
    """One process with the environment that the supervisor gives a rank; ``module:function`` in ``tests`` is its body."""
    path = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    return subprocess.Popen(
        [sys.executable, "-m", "tests.support.worker.ranks", body],
        env={**os.environ, **placement(rank, ranks, port), "PYTHONPATH": path, **env},
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def run_ranks(
    body: str, ranks: int, env: dict[str, str] | None = None, *, timeout: float = 90.0
) -> list[tuple[int, str, str]]:
    """Run ``ranks`` ranks to their ends; (exit code, stdout, stderr) of each."""
    port = free_port()
    processes = [start_rank(body, rank, ranks, port, env or {}) for rank in range(ranks)]
    try:
        outputs = [process.communicate(timeout=timeout * PATIENCE) for process in processes]
    finally:
        for process in processes:
            process.kill()
    return [(process.returncode, *output) for process, output in zip(processes, outputs, strict=True)]


def training(store: Path, *, epoch: int = 1, run: str = "run", **train: Any) -> dict[str, str]:
    """The environment of a training job on :class:`tests.support.worker.point_task.Point`."""
    checkpoint = {"every": train.pop("every", 100), "keep": train.pop("keep", 10)}
    extra: dict[str, str] = {
        key: str(train.pop(key)) for key in ("MUSTER_CHECKPOINT", "MUSTER_JOB_EPOCH", "MUSTER_PARENT") if key in train
    }
    section = {"task": "Point", "worlds": 8, "iterations": 6, "seed": 3, **train}
    spec = {"name": "point", "train": section, "checkpoint": checkpoint}
    return {
        "MUSTER_STORE": str(store),
        "MUSTER_RUN": run,
        "MUSTER_EPOCH": str(epoch),
        "MUSTER_JOB_EPOCH": "1",
        "MUSTER_JOB_ID": "job",
        "MUSTER_SPEC": json.dumps(spec),
        **extra,
    }


def train() -> int:
    """What ``worker.train`` does, with the test double as the task."""
    from tests.support.worker.point_task import TASK
    from worker.learning import leaving
    from worker.learning.distributed import RankPlacement, connect, use_cpu_threads
    from worker.learning.job import Job, StopRequest
    from worker.learning.loop import Loop
    from worker.learning.training import Training
    from worker.train import hooks

    stop = StopRequest().listen()
    job = Job.from_env(os.environ, "train")
    use_cpu_threads(os.environ)
    gang = connect(
        RankPlacement.from_env(os.environ), report_seconds=float(os.environ.get("MUSTER_REPORT_SECONDS", "60"))
    )
    code = leaving.train(Loop(Training.of(job, TASK), gang, stop, hooks()), stop)
    gang.close()
    return code


if __name__ == "__main__":
    from worker.learning.job import run_command

    module, _, function = sys.argv[1].rpartition(":")
    run_command(getattr(importlib.import_module(f"tests.{module}") if module else sys.modules["__main__"], function))
