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
    asked: dict[str, Any] = json.loads(sys.argv[1])
    device, wait = device_facts()
    clock = Clock(asked["began"], asked["worlds"], asked["steps"], wait)
    clock.install()
    with tempfile.TemporaryDirectory() as store:
        # one world gives the job's configuration; the runner builds its own worlds for training
        loop = build_loop({**asked, "worlds": 1}, Path(store))
        share = type(loop.share).of(0, 1, asked["worlds"])
        task = build_task(type(loop.task), loop.config, share, loop.gang, asked["seed"])
        settings = loop.training.settings
        loop.close()
    logs = Path(asked["logs"])
    logs.mkdir(parents=True, exist_ok=True)
    runner = stock_runner(task, settings, str(logs), save_interval=asked["save_every"])
    runner.learn(asked["iterations"], init_at_random_ep_len=True)
    clock.write(
        asked["out"],
        device=device,
        solver={"substeps": task.config.substeps, **task.solver_options},
        network={"hidden_sizes": asked["hidden_sizes"]},
        versions=versions("muster", "newton", "mujoco-warp", "warp-lang", "rsl-rl-lib", "torch"),
    )


if __name__ == "__main__":
    main()
