"""Whole trainings of each built-in task with its own settings, and of rsl-rl's own runner: reward against time and steps.

    python -m benchmarks.curves [--tasks Ant Humanoid Quadruped] [--stock Ant] [--out DIRECTORY]

Writes ``curves.md``, ``curves.json``, and ``curves.png`` where matplotlib is installed (without a GPU ``curves_cpu.*``, with fewer
worlds). The clock starts with the first iteration; earlier work (imports, worlds, kernels) is reported separately. At the end each
policy's mean action is evaluated from new starts, and if a task's solver has limits, also in a simulation without them. A loaded machine
is refused: :mod:`benchmarks.load`. Without a GPU use ``make bench``, as for :mod:`benchmarks.training`.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from benchmarks.load import Watch, add_option, reported
from benchmarks.stock import stock_runner
from benchmarks.training import CUDA, build, wait
from worker.evaluation.evaluation import evaluate
from worker.learning.loop import Loop
from worker.learning.setup import build_task

PLAN = {
    "Cartpole": (4096, 60),
    "Ant": (4096, 300),
    "Humanoid": (4096, 500),
    "Quadruped": (4096, 300),
    "CartpolePixels": (1024, 250),
}
"""Worlds and iterations on a GPU."""
PLAN_CPU = {"Cartpole": (64, 150), "CartpolePixels": (64, 60)}
STOCK, STOCK_CPU = ["Ant"], ["Cartpole"]
"""Tasks that rsl-rl's own runner trains too."""
NAME = "curves" if CUDA else "curves_cpu"
REFERENCE = {"iterations": 100, "ls_iterations": 50, "tolerance": 1e-8}
"""MuJoCo's own defaults for its solver."""


def train(task: str, worlds: int, iterations: int, store: Path, seed: int = 0) -> dict[str, Any]:
    """Reward, episode length and seconds after each iteration, and the evaluation of the final policy."""
    started = time.perf_counter()
    runner = build(task, worlds, store, seed)
    built = time.perf_counter() - started
    started = time.perf_counter()
    curve, failed = [], 0.0
    for _ in range(iterations):
        record = runner._iterate()[0]
        failed += record["nan_worlds"]
        seconds = time.perf_counter() - started
        curve.append([round(seconds, 3), record["env_steps"], record["reward"], record["episode_length"]])
    terms = {name: value for name, value in record.items() if name.startswith("reward_")}
    found = {"task": task, "worlds": worlds, "built_s": built, "seconds": seconds, "terms": terms, "curve": curve}
    return found | {"failed_worlds": failed} | worth(runner)


def worth(runner: Loop) -> dict[str, float]:
    """Mean return of the policy's mean action, as trained and under :data:`REFERENCE`."""
    own = evaluate(runner.task, runner.algorithm.policy(), runner.gang, checkpoint="-")
    found = {"evaluated": own.mean_return, "evaluated_length": own.mean_length, "longest": own.max_length}
    options = type(runner.task).solver_options
    if "iterations" in options and CUDA:
        exact: Any = type(
            type(runner.task).__name__, (type(runner.task),), {"solver_options": {**options, **REFERENCE}}
        )
        task = build_task(exact, runner.config, runner.share, runner.gang, 1)
        found["reference"] = evaluate(task, runner.algorithm.policy(), runner.gang, checkpoint="-").mean_return
    return found


def train_stock(task: str, worlds: int, iterations: int, store: Path, seed: int = 0) -> dict[str, Any]:
    """The same with rsl-rl's own runner, on worlds of the same seed."""
    runner = build(task, worlds, store / "stock", seed)
    config, own = runner.config.ppo, runner.task
    stock = stock_runner(own, config)
    own.clear_statistics()
    curve: list[list[Any]] = []
    reward = length = None
    seconds = 0.0
    every = 5
    for done in range(0, iterations, every):
        started = time.perf_counter()
        with contextlib.redirect_stdout(io.StringIO()):
            stock.learn(every)  # the worlds' clocks are staggered already
        wait()
        seconds += time.perf_counter() - started
        episodes, returns, lengths = own.statistics[:3].tolist()
        own.clear_statistics()
        if episodes:
            reward, length = returns / episodes, lengths / episodes
        curve.append([round(seconds, 3), (done + every) * worlds * config.steps, reward, length])
    return {"task": task, "worlds": worlds, "stock": True, "seconds": seconds, "curve": curve}


def main() -> None:
    plan = PLAN if CUDA else PLAN_CPU
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="+", default=list(plan))
    parser.add_argument(
        "--stock", nargs="*", default=STOCK if CUDA else STOCK_CPU, help="tasks that rsl-rl trains, too"
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent)
    add_option(parser)
    options = parser.parse_args()
    for rows in train_all(options.tasks, options.stock, Watch(options.loaded_anyway), options.seed):
        write(rows, options.out)
    draw(rows, options.out)


def train_all(tasks: list[str], stock: list[str], watch: Watch, seed: int = 0) -> Iterator[list[dict[str, Any]]]:
    """The rows so far, after each of ``tasks``, then after each training by rsl-rl."""
    plan, rows = PLAN if CUDA else PLAN_CPU, list[dict[str, Any]]()
    with tempfile.TemporaryDirectory() as store:
        for task, trainer in [(task, train) for task in tasks] + [(task, train_stock) for task in stock]:
            row = trainer(task, *plan.get(task, (64, 60)), Path(store), seed)
            rows.append(row | watch.check(f"while {task} was trained"))
            print({key: value for key, value in rows[-1].items() if key != "curve"}, rows[-1]["curve"][-1], flush=True)
            yield rows


def write(rows: list[dict[str, Any]], directory: Path) -> None:
    """The table, and its numbers, into ``directory``."""
    (directory / f"{NAME}.json").write_text(json.dumps(rows))
    (directory / f"{NAME}.md").write_text(table(rows))


def table(rows: list[dict[str, Any]]) -> str:
    """Markdown."""
    lines = [
        "# Whole trainings",
        "",
        f"`python -m benchmarks.curves`, each task with its own settings. {reported(rows)} ![reward against steps]({NAME}.png)",
        "",
        "| task | by | worlds | steps | time | mean return | of the mean action | under MuJoCo's own solver limits | its length |",
        "|---|---|--:|--:|--:|--:|--:|--:|--:|",
    ]
    for row in rows:
        steps, reward = row["curve"][-1][1:3]
        evaluated = f"{row['evaluated']:,.1f}" if "evaluated" in row else "–"
        reference = f"{row['reference']:,.1f}" if "reference" in row else "–"
        length = f"{row['evaluated_length']:.0f} of {row['longest']}" if "evaluated" in row else "–"
        lines.append(
            f"| {row['task']} | {'stock rsl-rl' if row.get('stock') else 'Muster'} | {row['worlds']:,} | {steps / 1e6:.1f} M | "
            f"{row['seconds']:.1f} s | {reward:,.1f} | {evaluated} | {reference} | {length} |"
        )
    return "\n".join(lines) + "\n"


def draw(rows: list[dict[str, Any]], directory: Path) -> None:
    """Plot mean return of finished episodes against steps, one panel per task; do nothing without matplotlib."""
    try:
        import matplotlib
    except ImportError:
        return

    matplotlib.use("Agg")
    from matplotlib import pyplot

    tasks = list(dict.fromkeys(row["task"] for row in rows))
    figure, panels = pyplot.subplots(1, len(tasks), figsize=(4 * len(tasks), 3), squeeze=False)
    for row in rows:
        panel = panels[0][tasks.index(row["task"])]
        points = [(steps / 1e6, reward) for _, steps, reward, _ in row["curve"] if reward is not None]
        label = f"{'stock rsl-rl' if row.get('stock') else 'Muster'}, {row['seconds']:.0f} s"
        panel.plot(*zip(*points, strict=True), label=label)
        panel.set_title(f"{row['task']}, {row['worlds']:,} worlds")
        panel.set_xlabel("million steps")
        panel.legend()
    panels[0][0].set_ylabel("mean return")
    figure.tight_layout()
    figure.savefig(directory / f"{NAME}.png", dpi=100)


if __name__ == "__main__":
    main()
