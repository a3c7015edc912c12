"""Wall-clock speed of one PPO configuration in four loops, each with its logging and a checkpoint every 25 iterations.

    python -m benchmarks.loops [--tasks Ant Humanoid Cartpole] [--worlds 4096] [--out DIRECTORY]

They are ``algorithm: ppo`` and ``algorithm: rsl_rl`` in the loop of ``muster run``, and rsl-rl's own runner with TensorBoard: unchanged,
and tuned (``check_for_nan: false``). All train on the same simulation. Writes ``loops.md``.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import statistics
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any
from unittest import mock

from benchmarks.load import Watch, add_option, reported
from benchmarks.stock import stock_config, stock_runner
from benchmarks.training import build, device_name, wait
from shared_store.volume.metrics import read_metrics
from worker.learning.setup import build_task

EVERY = 25
WARM = 10
"""Uncounted first iterations, which record graphs and load kernels."""


def in_muster(task: str, worlds: int, iterations: int, algorithm: str) -> float:
    """Steps per second, from the metrics of a whole run of the loop."""
    with tempfile.TemporaryDirectory() as directory:
        store = Path(directory)
        own: dict[str, Any] = {}
        if algorithm == "rsl_rl":
            template = build(task, 1, store / "template")
            own["rsl_rl"] = stock_config(template.task, template.config.ppo)
            template.close()
        loop = build(task, worlds, store / "store", every=EVERY, iterations=iterations, algorithm=algorithm, **own)
        with contextlib.redirect_stdout(io.StringIO()):
            loop.train()
        records = read_metrics(loop.job.run)
        loop.close()
    first, last = records[WARM - 1], records[-1]
    return float((last["env_steps"] - first["env_steps"]) / (last["total_seconds"] - first["total_seconds"]))


def in_rsl_rl(task: str, worlds: int, iterations: int, **changes: Any) -> float:
    """Steps per second of rsl-rl's own runner, between two of its log entries."""
    with tempfile.TemporaryDirectory() as directory:
        loop = build(task, worlds, Path(directory) / "store")
        ppo, own = loop.config.ppo, build_task(type(loop.task), loop.config, loop.share, loop.gang, 1)
        runner = stock_runner(own, ppo, str(Path(directory) / "logs"), save_interval=EVERY, **changes)
        logged: list[float] = []
        log = runner.logger.log

        def noting(**entry: Any) -> None:
            log(**entry)
            wait()
            logged.append(time.perf_counter())

        with mock.patch.object(runner.logger, "log", noting), contextlib.redirect_stdout(io.StringIO()):
            runner.learn(iterations)
        loop.close()
    return worlds * ppo.steps * (iterations - WARM) / (logged[-1] - logged[WARM - 1])


WAYS: dict[str, Callable[[str, int, int], float]] = {
    "Muster, ppo": partial(in_muster, algorithm="ppo"),
    "Muster, rsl_rl": partial(in_muster, algorithm="rsl_rl"),
    "rsl-rl's runner": in_rsl_rl,
    "rsl-rl's runner, tuned": partial(in_rsl_rl, check_for_nan=False),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="+", default=["Ant", "Humanoid", "Cartpole"])
    parser.add_argument("--worlds", type=int, default=4096)
    parser.add_argument("--iterations", type=int, default=110)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent)
    add_option(parser)
    options = parser.parse_args()
    watch, rows = Watch(options.loaded_anyway), list[dict[str, Any]]()
    found: dict[tuple[str, str], list[float]] = {}
    for task in options.tasks:
        for _ in range(options.repeats):  # alternating, so that changes of the machine affect all of them
            for way, measure in WAYS.items():
                found.setdefault((task, way), []).append(measure(task, options.worlds, options.iterations))
                rows.append(watch.check(f"while {task} was measured"))
                print(task, way, found[task, way][-1], flush=True)
                (options.out / "loops.md").write_text(table(found, options.worlds, rows))


def table(found: dict[tuple[str, str], list[float]], worlds: int, rows: list[dict[str, Any]]) -> str:
    """Markdown of the steps per second, by task and loop."""
    lines = [
        f"# One configuration, four loops, on {device_name()}",
        "",
        f"Million steps a second by the clock, with logging and checkpoints, {worlds:,} worlds; medians of several runs in turn; "
        f"`python -m benchmarks.loops`. {reported(rows)}",
        "",
        f"| task | runs | {' | '.join(WAYS)} |",
        "|---|--:|" + "--:|" * len(WAYS),
    ]
    for task in dict.fromkeys(task for task, _ in found):
        of_it = [found[task, way] for way in WAYS if (task, way) in found]
        rates = (f"{statistics.median(each) / 1e6:.3f}" for each in of_it)
        lines.append(f"| {task} | {len(of_it[-1])} | {' | '.join(rates)} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
