"""Whether trainings keep what they learnt: many seeds, several times as long as the specs in ``job_specs`` train.

    python -m benchmarks.keeping [cartpole ant ...] [--by default then stock] [--at-once 8] [--out DIRECTORY]
    python -m benchmarks.keeping --table                        # writes keeping.md, keeping.json and keeping.png

Each training is a separate process; ``keeping.jsonl`` gets a line whenever one has made a two-hundredth of its iterations. Trainings
that it or ``keeping.json`` already holds whole are left out, so an interrupted benchmark continues where it stopped. Every spec is trained ``default``, with
the settings that a new job gets; and on request as ``then``, with those of runs that began before limits existed, by ``stock`` rsl_rl, or
with other settings: ``--by 'name={"min_std": 0.05}'``. Without matplotlib, only the picture is left out.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from benchmarks.keeping_table import ON_CPU, PLAN, POINTS, WORLDS, curves_of, draw, is_whole, keep, table
from shared_store.volume.learning_metrics import LEARNING
from worker.settings.ppo import PPOConfig

SPECS = Path(__file__).parents[1] / "job_specs"
SHOWN = [metric.name for metric in LEARNING]
COUNTED = ("nan_worlds", "solver_overflows")


@dataclass
class Training:
    """One training of the plan."""

    spec: str
    by: str
    seed: int
    iterations: int
    settings: Mapping[str, Any] | None = field(default=None, compare=False)
    """Changes of PPO's settings; None: stock rsl_rl trains."""

    @property
    def key(self) -> tuple[str, str, int, int]:
        return self.spec, self.by, self.seed, self.iterations


def section_of(spec: str) -> tuple[dict[str, Any], int]:
    """The ``train`` section of a spec, and its worlds on all ranks."""
    document = yaml.safe_load((SPECS / f"{spec}.yaml").read_text())
    nodes = document.get("nodes", 1)
    section = document["train"]
    return section, WORLDS.get(spec, section["worlds"] * (nodes if isinstance(nodes, int) else nodes["max"]))


def train(training: Training) -> Iterator[dict[str, Any]]:
    """Points of the curve: iterations done, seconds, episodes and their mean return since the last point, means of :data:`SHOWN`."""
    import torch

    from benchmarks.training import build

    torch.set_num_threads(1)
    section, worlds = section_of(training.spec)
    own = {key: section[key] for key in ("config", "algorithm", "ppo", "sac") if key in section}
    if training.settings:
        own["ppo"] = {**own.get("ppo", {}), **training.settings}
    with tempfile.TemporaryDirectory() as store:
        loop = build(section["task"], worlds, Path(store), training.seed, **own)
        points = stock_points(loop, training) if training.settings is None else own_points(loop, training)
        started = time.perf_counter()
        for point in points:
            yield {"iterations": training.iterations, "seconds": round(time.perf_counter() - started, 2), **point}


def own_points(loop: Any, training: Training) -> Iterator[dict[str, Any]]:
    """The points of Muster's own training."""
    every = max(1, training.iterations // POINTS)
    records: list[dict[str, Any]] = []
    for done in range(1, training.iterations + 1):
        records.append(loop._iterate()[0])
        if done % every == 0 or done == training.iterations:
            ended = sum(record["episodes"] for record in records)
            total = sum(record["episodes"] * record["reward"] for record in records if record["episodes"])
            shown = {name: mean([record[name] for record in records]) for name in SHOWN if name in records[-1]}
            counted = {name: sum(record.get(name) or 0 for record in records) for name in COUNTED}
            yield {"iteration": done, "episodes": ended, "reward": total / ended if ended else None, **shown, **counted}
            records.clear()


def stock_points(loop: Any, training: Training) -> Iterator[dict[str, Any]]:
    """The points of rsl_rl's own runner with the same settings, on the same worlds."""
    from benchmarks.stock import stock_runner

    runner, task = stock_runner(loop.task, loop.algorithm.config), loop.task
    every = max(1, training.iterations // POINTS)
    task.clear_statistics()
    for done in range(every, training.iterations + 1, every):
        with contextlib.redirect_stdout(io.StringIO()):
            runner.learn(every)
        episodes, returns, *_ = task.statistics.tolist()
        task.clear_statistics()
        yield {"iteration": done, "episodes": int(episodes), "reward": returns / episodes if episodes else None}


def mean(values: list[float]) -> float:
    return sum(values) / len(values)


# -- many at once -------------------------------------------------------------------------------------------------------


class Trainer:
    """Trains a plan, several at once, and appends their points to a file."""

    def __init__(self, path: Path, gpus: list[str]) -> None:
        self._path, self._gpus, self._lock = path, gpus, threading.Lock()
        self._warm: dict[str, threading.Event] = {}
        self._started = 0

    def train_all(self, plan: list[Training], at_once: int) -> None:
        """``at_once``: processes at the same time. The first of each spec compiles kernels, for which the others wait."""
        done = {key for key, points in curves_of(self._path.parent).items() if is_whole(key, points)}
        plan = [training for training in plan if training.key not in done]
        first = {training.spec: training for training in reversed(plan)}
        plan.sort(key=lambda training: training is not first[training.spec])
        self._warm = {spec: threading.Event() for spec in first}
        with ThreadPoolExecutor(at_once) as pool:
            for result in [pool.submit(self._train, training, training is first[training.spec]) for training in plan]:
                result.result()

    def _train(self, training: Training, is_first: bool) -> None:
        warm = self._warm[training.spec]
        if not is_first:
            warm.wait()
        command = [sys.executable, "-m", "benchmarks.keeping", "--train", json.dumps(vars(training))]
        with self._lock:
            device = "" if training.spec in ON_CPU or not self._gpus else self._gpus[self._started % len(self._gpus)]
            self._started += device != ""
        environment = {**os.environ, "OMP_NUM_THREADS": "1", "CUDA_VISIBLE_DEVICES": device}
        try:
            with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment) as process:
                assert process.stdout is not None
                for line in process.stdout:
                    if line.startswith("{"):
                        warm.set()
                        self._append(
                            {**dict(zip(("spec", "by", "seed"), training.key, strict=False)), **json.loads(line)}
                        )
            print(*training.key, "done" if process.returncode == 0 else f"failed: {process.returncode}", flush=True)
        finally:
            warm.set()

    def _append(self, point: dict[str, Any]) -> None:
        with self._lock, self._path.open("a") as file:
            file.write(json.dumps(rounded(point)) + "\n")


def rounded(point: Mapping[str, Any]) -> dict[str, Any]:
    return {name: float(f"{value:.5g}") if isinstance(value, float) else value for name, value in point.items()}


def planned(options: argparse.Namespace) -> list[Training]:
    """The trainings that the command asks for."""
    kinds: dict[str, Mapping[str, Any] | None] = {"default": {}, "then": PPOConfig.before, "stock": None}
    for requested in options.by:
        name, equals, settings = requested.partition("=")
        kinds |= {name: json.loads(settings)} if equals else {}
    plan = []
    for spec in options.specs or PLAN:
        seeds, times = PLAN[spec]
        iterations = round(section_of(spec)[0]["iterations"] * (options.times or times))
        for by in (requested.partition("=")[0] for requested in options.by):
            plan += [Training(spec, by, seed, iterations, kinds[by]) for seed in range(options.seeds or seeds)]
    return plan


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("specs", nargs="*", help=f"files in job_specs, without .yaml; by default {', '.join(PLAN)}")
    parser.add_argument("--by", nargs="+", default=["default"], help="default, then, stock, or NAME=SETTINGS")
    parser.add_argument("--seeds", type=int, help="instead of the plan's number")
    parser.add_argument("--times", type=float, help="instead of the plan's multiple of the spec's iterations")
    parser.add_argument("--at-once", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--gpus", nargs="*", default=[], help="GPUs among which the trainings are divided, by number")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent)
    parser.add_argument("--table", action="store_true", help="only write the table and the picture")
    parser.add_argument("--train", help=argparse.SUPPRESS)  # one training, in this process
    options = parser.parse_args()
    if options.train:
        for point in train(Training(**json.loads(options.train))):
            print(json.dumps(point), flush=True)
        os._exit(0)  # not joining the threads of the loop
    options.out.mkdir(parents=True, exist_ok=True)
    path = options.out / "keeping.jsonl"
    if not options.table:
        Trainer(path, options.gpus).train_all(planned(options), options.at_once)
    curves = curves_of(options.out)
    print(table(curves))
    if options.table:
        keep(curves, options.out / "keeping.json")
        (options.out / "keeping.md").write_text(table(curves))
        with contextlib.suppress(ImportError):
            draw(curves, options.out / "keeping.png")


if __name__ == "__main__":
    main()
