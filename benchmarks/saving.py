"""Cost of a save for each task on this device: the additional time of iterations around a save.

    python -m benchmarks.saving [--tasks Ant Humanoid Cartpole] [--iterations 180] [--out DIRECTORY]

It saves every third iteration, far more often than a run does, for many comparisons: in the iteration before a save the device makes the
copies, in the one after it threads write them, and the third is unaffected. Writes ``saving.md``.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import statistics
import tempfile
from itertools import pairwise
from pathlib import Path
from typing import Any

from benchmarks.load import Watch, add_option, reported
from benchmarks.training import CUDA, build, device_name
from shared_store.volume.checkpoints import list_checkpoints
from shared_store.volume.metrics import read_metrics

WORLDS = dict.fromkeys(("Ant", "Humanoid", "Cartpole", "Quadruped"), 4096) | {"CartpolePixels": 1024}
WORLDS_CPU = {"Ant": 64, "Humanoid": 32, "Cartpole": 64, "Quadruped": 32, "CartpolePixels": 32}
WARM = 10
"""Uncounted first iterations, which record graphs and load kernels."""


def measure(task: str, worlds: int, iterations: int) -> dict[str, Any]:
    """Wall-clock milliseconds of iterations before, after and far from a save, and of the host's part; bytes of a checkpoint."""
    with tempfile.TemporaryDirectory() as store:
        loop = build(task, worlds, Path(store), every=3, iterations=iterations)
        with contextlib.redirect_stdout(io.StringIO()):
            loop.train()
        records = read_metrics(loop.job.run)[WARM:]
        last = list_checkpoints(loop.job.run)[-1].path
        size = sum(file.stat().st_size for file in last.rglob("*") if file.is_file())
        loop.close()
    took = [1000 * (after["total_seconds"] - before["total_seconds"]) for before, after in pairwise(records)]
    saves = [
        index for index, record in enumerate(records[1:]) if record["stall_seconds"] > 0 and 0 < index < len(took) - 1
    ]
    return {
        "task": task,
        "worlds": worlds,
        "size": size,
        "saves": len(saves),
        "before": statistics.median(took[index - 1] for index in saves),
        "after": statistics.median(took[index] for index in saves),
        "far": statistics.median(took[index + 1] for index in saves),
        "host": statistics.median(1000 * records[index + 1]["stall_seconds"] for index in saves),
    }


def table(rows: list[dict[str, Any]]) -> str:
    """Markdown."""
    lines = [
        f"# What a save costs, on {device_name()}",
        "",
        f"Medians, by the clock; `python -m benchmarks.saving`. {reported(rows)}",
        "",
        "| task | worlds | a checkpoint | saves | an iteration [ms] | before a save | after it | both together | host, meanwhile [ms] |",
        "|---|--:|--:|--:|--:|--:|--:|--:|--:|",
    ]
    lines += [
        f"| {row['task']} | {row['worlds']:,} | {row['size'] / 1e6:.1f} MB | {row['saves']} | {row['far']:.2f} | "
        f"{row['before'] - row['far']:+.2f} | {row['after'] - row['far']:+.2f} | "
        f"{(row['before'] + row['after']) / row['far'] - 2.0:+.1%} | {row['host']:.2f} |"
        for row in rows
    ]
    return "\n".join(lines) + "\n"


def main() -> None:
    worlds = WORLDS if CUDA else WORLDS_CPU
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="+", default=list(worlds), choices=list(worlds))
    parser.add_argument("--iterations", type=int, default=180)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent)
    add_option(parser)
    options = parser.parse_args()
    watch, rows = Watch(options.loaded_anyway), list[dict[str, Any]]()
    for task in options.tasks:
        rows.append(measure(task, worlds[task], options.iterations) | watch.check(f"while {task} was measured"))
        (options.out / "saving.md").write_text(table(rows))
    print(table(rows))


if __name__ == "__main__":
    main()
