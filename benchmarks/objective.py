"""The loss of the fused PPO in three forms, in one run: the hand-written kernel, plain torch, and plain torch with torch.compile.

    python -m benchmarks.objective [--tasks Ant Humanoid] [--worlds 4096] [--out DIRECTORY]

Writes ``objective.md``: milliseconds of learning and of an iteration. Everything else is the same, including the captured graphs.
"""

from __future__ import annotations

import argparse
import contextlib
import statistics
import tempfile
import time
from pathlib import Path
from typing import Any
from unittest import mock

import torch

from benchmarks.load import Watch, add_option, told
from benchmarks.training import build, device_name, wait
from worker.learning.ppo import fused, heads

WAYS = ("kernel", "torch", "torch.compile")
STRETCHES, ITERATIONS = 5, 15


def measure(task: str, worlds: int, way: str) -> dict[str, float]:
    """Medians [ms] of an iteration, and of learning in it, on this device."""
    with contextlib.ExitStack() as stack:
        if way != "kernel":
            stack.enter_context(mock.patch.object(fused, "Gaussian", _plain))
        for name in ("clipped_loss", "gaussian_terms") if way == "torch.compile" else ():
            stack.enter_context(mock.patch.object(heads, name, torch.compile(getattr(heads, name))))
        loop = build(task, worlds, Path(stack.enter_context(tempfile.TemporaryDirectory())))
        for _ in range(6):
            loop._iterate()
        found = []
        for _ in range(STRETCHES):
            wait()
            started = time.perf_counter()
            learnt = [loop._iterate()[0]["learn_seconds"] for _ in range(ITERATIONS)]
            wait()
            found.append(((time.perf_counter() - started) / ITERATIONS, statistics.median(learnt)))
        loop.close()
    iteration, learn = (1000 * statistics.median(each) for each in zip(*found, strict=True))
    return {"iteration": iteration, "learn": learn}


def _plain(*given: Any, **named: Any) -> heads.Gaussian:
    return heads.Gaussian(*given, **{**named, "plain": True})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="+", default=["Ant", "Humanoid"])
    parser.add_argument("--worlds", type=int, default=4096)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent)
    add_option(parser)
    options = parser.parse_args()
    watch, rows, lines = Watch(options.loaded_anyway), [], []
    for task in options.tasks:
        for way in WAYS:
            found = measure(task, options.worlds, way)
            rows.append(watch.check(f"while {task} was measured"))
            lines.append(f"| {task} | {way} | {found['learn']:.2f} | {found['iteration']:.2f} |")
            print(lines[-1], flush=True)
            head = [
                f"# The loss of the fused PPO on {device_name()}",
                "",
                f"{options.worlds:,} worlds, medians in ms, one run; `python -m benchmarks.objective`. {told(rows)}",
                "",
                "| task | loss | learning | iteration |",
                "|---|---|--:|--:|",
            ]
            (options.out / "objective.md").write_text("\n".join([*head, *lines]) + "\n")


if __name__ == "__main__":
    main()
