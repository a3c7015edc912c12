"""What a save costs the training, for each task on this device: how much longer the iterations with a save take than those without.

    python -m benchmarks.saving [--tasks Ant Humanoid Cartpole] [--iterations 180] [--out DIRECTORY]

It saves every third iteration, far more often than a run does, so that there are many to compare. Writes ``saving.md``.
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

from benchmarks.load import Watch, add_option, told
from benchmarks.training import CUDA, build, device_name
from shared_store.checkpoints import list_checkpoints
from shared_store.metrics import read_metrics

WORLDS = dict.fromkeys(("Ant", "Humanoid", "Cartpole", "Quadruped"), 4096) | {"CartpolePixels": 1024}
WORLDS_CPU = {"Ant": 64, "Humanoid": 32, "Cartpole": 64, "Quadruped": 32, "CartpolePixels": 32}
WARM = 10
"""Iterations that are not counted: graphs are recorded, kernels loaded."""


def measure(task: str, worlds: int, iterations: int) -> dict[str, Any]:
    """Milliseconds by the clock of an iteration without and with a save, what the loop itself waits [ms], and bytes of a checkpoint."""
    with tempfile.TemporaryDirectory() as store:
        loop = build(task, worlds, Path(store), every=3, iterations=iterations)
        with contextlib.redirect_stdout(io.StringIO()):
            loop.train()
        records = read_metrics(loop.job.run)[WARM:]
        last = list_checkpoints(loop.job.run)[-1].path
        size = sum(file.stat().st_size for file in last.rglob("*") if file.is_file())
        loop.close()
    took: dict[bool, list[float]] = {True: [], False: []}
    for before, after in pairwise(records):
        took[after["stall_seconds"] > 0].append(1000 * (after["total_seconds"] - before["total_seconds"]))
    stalls = [1000 * record["stall_seconds"] for record in records if record["stall_seconds"] > 0]
    return {
        "task": task,
        "worlds": worlds,
        "size": size,
        "saves": len(stalls),
        "without": statistics.median(took[False]),
        "with": statistics.median(took[True]),
        "stall": statistics.median(stalls),
    }


def table(rows: list[dict[str, Any]]) -> str:
    """Markdown."""
    lines = [
        f"# What a save costs, on {device_name()}",
        "",
        f"Medians, by the clock; `python -m benchmarks.saving`. {told(rows)}",
        "",
        "| task | worlds | a checkpoint | saves | iteration without | with a save | the loop waits | of an iteration |",
        "|---|--:|--:|--:|--:|--:|--:|--:|",
    ]
    lines += [
        f"| {row['task']} | {row['worlds']:,} | {row['size'] / 1e6:.1f} MB | {row['saves']} | {row['without']:.2f} ms | "
        f"{row['with']:.2f} ms | {row['stall']:.2f} ms | {row['with'] / row['without'] - 1.0:+.1%} |"
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
