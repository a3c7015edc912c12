"""Wall time, from the first iteration on, until an arm lifts a cube to its targets.

    python -m benchmarks.lifting [--task LiftCube|LiftCubes] [--worlds 4096] [--seconds 170] [--out DIRECTORY]

Trains as ``muster run`` does, with metrics and checkpoints, from the task's own settings. In the end the mean action plays an episode in
each of ``--judged`` held-out worlds. The times of building the worlds and of judging are reported separately. Writes
``lifting-<task>.json``, the curve as ``.png`` where matplotlib is installed, and a film of one world as ``.gif``.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from pathlib import Path
from typing import Any

import torch

from benchmarks.load import Watch, add_option
from benchmarks.peers.inside.clock import versions
from benchmarks.racer import film
from benchmarks.training import CUDA, build, device_name, wait
from worker.evaluation.evaluation import evaluate
from worker.learning.loop import Loop
from worker.learning.randomness import held_out_seed
from worker.learning.setup import build_task
from worker.tasks.run.adapting import adaptive_steps, begin_evaluation

CURVE = ("object_height", "position_error", "at_goal", "episode_success")
"""Metrics of the task to keep."""


class LiftingLoop(Loop):
    """A training that ends after a given time."""

    def within(self, seconds: float) -> None:
        """``seconds``: duration of the training; the clock starts with :meth:`train`."""
        self._limit = seconds
        self.curve: list[dict[str, Any]] = []
        """Of each iteration: ``seconds``, ``env_steps``, ``reward``, and the metrics of :data:`CURVE`."""

    def train(self) -> int:
        """As :meth:`Loop.train`; the clock starts here."""
        wait()
        self._began = time.perf_counter()
        return super().train()

    def _iterate(self) -> tuple[dict[str, Any], dict[str, float]]:
        record, signals = super()._iterate()
        seconds = time.perf_counter() - self._began
        metrics = {name: record.get(f"metric_{name}") for name in CURVE}
        row = {"seconds": seconds, "env_steps": record["env_steps"], "iteration": record["iteration"]}
        self.curve.append(row | {"reward": record["reward"]} | metrics)
        self.stop.requested |= seconds >= self._limit  # it saves after the next iteration, then exits
        return record, signals


def measure(options: argparse.Namespace, store: Path, clip: Path) -> dict[str, Any]:
    """Train, judge, and film one world."""
    loop = build(options.task, options.worlds, store, options.seed, loop_type=LiftingLoop)
    assert isinstance(loop, LiftingLoop)
    loop.within(options.seconds)
    loop.train()
    share = type(loop.share).of(0, 1, options.judged)
    worlds = build_task(type(loop.task), loop.config, share, loop.gang, held_out_seed(options.seed))
    last = loop.curve[-1]
    begin_evaluation(worlds, last["iteration"] - 1, last["reward"], None, adaptive_steps(loop.task))
    successes = evaluate(worlds, loop.algorithm.policy(), loop.gang, checkpoint="-").played.successes
    assert successes is not None
    row = {
        "task": options.task,
        "worlds": options.worlds,
        "seed": options.seed,
        "judged_worlds": options.judged,
        "success": successes.double().mean().item(),
        "device": device_name(),
        "versions": versions("muster", "newton", "warp-lang", "torch"),
        "curve": loop.curve,
    }
    run = loop.job.run
    loop.close()
    film(run, clip, options.clip_seconds)
    return row


def draw(row: dict[str, Any], path: Path) -> None:
    """Plot heights, distances and shares against the time of training; do nothing without matplotlib."""
    try:
        import matplotlib
    except ImportError:
        return
    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, (left, right) = pyplot.subplots(1, 2, figsize=(10, 3))
    seconds = [at["seconds"] for at in row["curve"]]
    for panel, names in ((left, CURVE[:2]), (right, CURVE[2:])):
        for name in names:
            panel.plot(seconds, [at[name] or 0.0 for at in row["curve"]], label=name.replace("_", " "))
        panel.set_xlabel("seconds of training")
        panel.grid(alpha=0.3)
        panel.legend()
    left.set_title("height of the cube, distance from the target [m]")
    right.set_title("share of the steps")
    figure.suptitle(f"{row['task']}, {row['worlds']:,} worlds, {row['device']}")
    figure.tight_layout()
    figure.savefig(path, dpi=100)
    pyplot.close(figure)


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.lifting", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--task", choices=("LiftCube", "LiftCubes"), default="LiftCube")
    parser.add_argument("--worlds", type=int, default=4096)
    parser.add_argument("--judged", type=int, default=256, help="held-out worlds of the evaluation")
    parser.add_argument("--seconds", type=float, default=170.0, help="of training")
    parser.add_argument("--clip-seconds", type=float, default=8.0, help="of the film, simulated")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent)
    add_option(parser)
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    watch = Watch(options.loaded_anyway)
    path = options.out / f"lifting-{options.task.lower()}.json"
    with tempfile.TemporaryDirectory() as store:
        row = measure(options, Path(store), path.with_suffix(".gif"))
    row |= watch.check(f"while {options.task} was learnt")
    path.write_text(json.dumps(row))
    draw(row, path.with_suffix(".png"))
    print(f"{100 * row['success']:.1f} % of {options.judged} episodes reach a target; written: {path}")
    if CUDA:
        torch.cuda.empty_cache()


if __name__ == "__main__":
    main()
