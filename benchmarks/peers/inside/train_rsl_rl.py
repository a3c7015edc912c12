"""One training by rsl_rl's own runner on Muster's simulation: ``python -m benchmarks.peers.inside.train_rsl_rl JSON``;
``benchmarks.peers.rsl_rl`` calls it. The JSON is that of ``train_mjlab.py``."""

from __future__ import annotations

import json
import sys
import tempfile
from pathlib import Path
from typing import Any

from benchmarks.peers.building import build_loop
from benchmarks.peers.inside.clock import Clock, device_facts, versions
from benchmarks.stock import stock_runner
from worker.learning.setup import build_task


def main() -> None:
    requested: dict[str, Any] = json.loads(sys.argv[1])
    device, wait = device_facts()
    clock = Clock(requested["began"], requested["worlds"], requested["steps"], wait)
    clock.install()
    with tempfile.TemporaryDirectory() as store:
        # one world gives the job's configuration; the runner builds its own worlds for training
        loop = build_loop({**requested, "worlds": 1}, Path(store))
        share = type(loop.share).of(0, 1, requested["worlds"])
        task = build_task(type(loop.task), loop.config, share, loop.gang, requested["seed"])
        settings = loop.training.settings
        loop.close()
    logs = Path(requested["logs"])
    logs.mkdir(parents=True, exist_ok=True)
    runner = stock_runner(task, settings, str(logs), save_interval=requested["save_every"])
    runner.learn(requested["iterations"], init_at_random_ep_len=True)
    clock.write(
        requested["out"],
        device=device,
        solver={"substeps": task.config.substeps, **task.solver_options},
        network={"hidden_sizes": requested["hidden_sizes"]},
        versions=versions("muster", "newton", "mujoco-warp", "warp-lang", "rsl-rl-lib", "torch"),
    )


if __name__ == "__main__":
    main()
