"""Whether trainings keep what they learnt: many seeds, several times as long as the specs in ``job_specs`` train.

    python -m benchmarks.keeping [cartpole ant ...] [--by default then stock] [--at-once 8] [--out DIRECTORY]
    python -m benchmarks.keeping --table                        # writes keeping.md, keeping.json and keeping.png

Each training is a process of its own; ``keeping.jsonl`` gets a line whenever one has made a two-hundredth of its iterations. Trainings
that it or ``keeping.json`` already holds whole are left out, so an interrupted benchmark continues where it stopped. Every spec is trained ``default``, with
the settings that a new job gets; and on request as ``then``, with those of runs that began before limits existed, by ``stock`` rsl_rl, or
with other settings: ``--by 'name={"min_std": 0.05}'``. Where matplotlib is missing there is no picture.
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

from shared_store.learning import LEARNING
from worker.learning.ppo.settings import PPOConfig

SPECS = Path(__file__).parents[1] / "job_specs"
PLAN: dict[str, tuple[int, float]] = {
    **dict.fromkeys(("cartpole", "racer", "my-task"), (10, 10)),
    **dict.fromkeys(("cartpole-pixels", "ant", "humanoid"), (3, 5)),
    **dict.fromkeys(("quadruped", "go1-flat", "g1-flat"), (2, 2)),
    **dict.fromkeys(
        ("racer-pixels", "lift-cube", "lift-cubes", "go1-rough", "g1-rough", "g1-walk", "g1-rough-walk"), (1, 1)
    ),
}
"""By spec: seeds, and how many times its iterations."""
ON_CPU = ("cartpole", "racer", "my-task")
WORLDS = {"ant": 4096}
"""Instead of a spec's worlds: with these the ant learns to run, as its spec says."""
POINTS = 200
"""Points of a curve."""
SHOWN = [metric.name for metric in LEARNING]
KINDS = ("default", "then", "stock")
KEPT_COLUMNS = ("iteration", "episodes", "reward", "action_std")
"""Those that ``keeping.json`` keeps of a point."""
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


Curve = list[dict[str, Any]]
Key = tuple[str, str, int, int]
"""Spec, settings, seed, iterations."""


def curves_of(directory: Path) -> dict[Key, Curve]:
    """The points of each training in ``keeping.json`` and ``keeping.jsonl``; of a training that was begun twice, those of the last time."""
    found: dict[Key, Curve] = {}
    kept, new = directory / "keeping.json", directory / "keeping.jsonl"
    for curve in json.loads(kept.read_text()) if kept.exists() else ():
        key = curve["spec"], curve["by"], curve["seed"], curve["iterations"]
        found[key] = [dict(zip(KEPT_COLUMNS, point, strict=True)) for point in curve["points"]]
    for line in new.read_text().splitlines() if new.exists() else ():
        point = json.loads(line)
        key = point["spec"], point["by"], point["seed"], point["iterations"]
        points = found.setdefault(key, [])
        if points and point["iteration"] <= points[-1]["iteration"]:
            points.clear()
        points.append(point)
    return found


def keep(curves: Mapping[Key, Curve], path: Path) -> None:
    """Write the finished trainings, with the columns that the table needs; one a line."""
    lines = []
    for key, points in sorted(curves.items()):
        if is_whole(key, points):
            rows = [[short(point.get(name)) for name in KEPT_COLUMNS] for point in points]
            head = dict(zip(("spec", "by", "seed", "iterations"), key, strict=True))
            lines.append(json.dumps({**head, "points": rows}, separators=(",", ":")))
    path.write_text("[\n" + ",\n".join(lines) + "\n]\n")


def short(value: Any) -> Any:
    return float(f"{value:.4g}") if isinstance(value, float) else value


def is_whole(key: Key, curve: Curve) -> bool:
    """Whether a training came to its end."""
    return bool(curve[-1]["iteration"] >= key[3] - key[3] // POINTS)


# -- the table ----------------------------------------------------------------------------------------------------------

WIDTH = 0.05
"""Share of a training over which returns are averaged."""
KEPT = 0.9
"""Least share of the best mean that the last one has."""


@dataclass
class Outcome:
    """What a curve comes to: mean returns over :data:`WIDTH` of the training, weighted by episodes."""

    first: float
    best: float
    end: float

    @property
    def kept(self) -> float:
        """The last mean as a share of the best one, of returns below 0 as a share of the gain."""
        if self.best > 0:
            return self.end / self.best
        return (self.end - self.first) / (self.best - self.first) if self.best > self.first else 1.0

    @classmethod
    def of(cls, curve: Curve) -> Outcome:
        width = max(1, round(WIDTH * len(curve)))
        windows = [curve[at : at + width] for at in range(len(curve) - width + 1)]
        means = [weighed for window in windows if (weighed := weighted(window)) is not None]
        return cls(means[0], max(means), means[-1])


def weighted(points: Curve) -> float | None:
    """Mean return of the episodes of some points; None without any."""
    episodes = sum(point["episodes"] for point in points)
    return (
        sum(point["episodes"] * point["reward"] for point in points if point["episodes"]) / episodes
        if episodes
        else None
    )


def reached(curve: Curve, goal: float) -> int | None:
    """Iterations until the mean return of a point was ``goal``."""
    return next((point["iteration"] for point in curve if point["episodes"] and point["reward"] >= goal), None)


def dipped(curve: Curve) -> bool:
    """Whether a mean over :data:`WIDTH` fell below :data:`KEPT` of the best one after another had reached that."""
    width = max(1, round(WIDTH * len(curve)))
    means = [mean for at in range(len(curve) - width + 1) if (mean := weighted(curve[at : at + width])) is not None]
    goal = KEPT * max(means)
    reached = next(at for at, mean in enumerate(means) if mean >= goal)
    return min(means[reached:]) < goal


def median(values: list[float]) -> float:
    ordered = sorted(values)
    return (ordered[(len(ordered) - 1) // 2] + ordered[len(ordered) // 2]) / 2


def table(curves: Mapping[Key, Curve]) -> str:
    """Markdown: a row for each spec and kind of settings, over its seeds."""
    whole = {key: curve for key, curve in curves.items() if is_whole(key, curve)}
    lines = [
        "# Do trainings keep what they learnt?",
        "",
        f"`python -m benchmarks.keeping`, {', '.join(ON_CPU)} on one core each, the others on a GPU, ant with {WORLDS['ant']:,} worlds. Mean returns are over {WIDTH:.0%} of a training, weighted by episodes; *kept* is the last of "
        "these means as a share of the best one. *Dipped*: seeds whose mean fell below 90 % of the best one at any time after it had been "
        "there. *To 90 %*: iterations until a two-hundredth of the training had 90 % of the median best mean of the default settings.",
        "",
        "`default` are the settings of a new job; `then` those of runs that began before deviations and rates had limits; `stock` is "
        "rsl_rl's own runner with the settings of `then`. The other rows are what the defaults were chosen from: *floor* is `min_std` (0.1 "
        "where not named), *horizon* `learning_rate_horizon`, *normaliser* `normalizer_horizon`.",
        "",
        "![mean return of every seed](keeping.png)",
        "",
        f"| spec | by | seeds | iterations | seeds that kept {KEPT:.0%} | worst | dipped | median best | median end | to 90 % (worst) | deviation at the end |",
        "|---|---|--:|--:|--:|--:|--:|--:|--:|--:|--:|",
    ]
    for spec in (spec for spec in PLAN if any(key[0] == spec for key in whole)):
        of_spec = {key: curve for key, curve in whole.items() if key[0] == spec}
        usual = [Outcome.of(curve).best for key, curve in of_spec.items() if key[1] == "default"]
        goal = KEPT * median(usual) if usual else None
        for by, iterations in dict.fromkeys((key[1], key[3]) for key in sorted(of_spec, key=_rank)):
            its = [curve for key, curve in of_spec.items() if (key[1], key[3]) == (by, iterations)]
            outcomes = [Outcome.of(curve) for curve in its]
            kept = [outcome.kept for outcome in outcomes]
            times = [at for curve in its if goal is not None and (at := reached(curve, goal)) is not None]
            soon = (
                f"{median([float(at) for at in times]):.0f} ({max(times)})"
                if len(times) == len(its)
                else f"{len(times)} of {len(its)}"
            )
            deviations = [curve[-1]["action_std"] for curve in its if curve[-1].get("action_std") is not None]
            deviation = f"{min(deviations):.2g} to {max(deviations):.2g}" if deviations else "–"
            lines.append(
                f"| {spec} | {by} | {len(its)} | {iterations:,} | {sum(each >= KEPT for each in kept)} | {min(kept):.0%} | {sum(map(dipped, its))} | "
                f"{median([each.best for each in outcomes]):,.1f} | {median([each.end for each in outcomes]):,.1f} | {soon} | {deviation} |"
            )
    return "\n".join(lines) + "\n"


def _rank(key: Key) -> int:
    return KINDS.index(key[1]) if key[1] in KINDS else len(KINDS)


def draw(curves: Mapping[Key, Curve], path: Path) -> None:
    """Plot the mean return of every seed, a panel for each spec and each of :data:`KINDS`."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    curves = {key: curve for key, curve in curves.items() if key[1] in KINDS}
    panels = list(
        dict.fromkeys(key[:2] for key in sorted(curves, key=lambda key: (list(PLAN).index(key[0]), _rank(key))))
    )
    columns = min(4, len(panels))
    rows = -(-len(panels) // columns)
    figure, places = pyplot.subplots(rows, columns, figsize=(4 * columns, 2.6 * rows), squeeze=False)
    for place in places.flat[len(panels) :]:
        place.axis("off")
    for key, curve in curves.items():
        place = places.flat[panels.index(key[:2])]
        points = [(point["iteration"], point["reward"]) for point in curve if point["episodes"]]
        place.plot(*zip(*points, strict=True), linewidth=0.7)
        place.set_title(f"{key[0]}, {key[1]}", fontsize=9)
    figure.tight_layout()
    figure.savefig(path, dpi=90)


def planned(options: argparse.Namespace) -> list[Training]:
    """The trainings that the command asks for."""
    kinds: dict[str, Mapping[str, Any] | None] = {"default": {}, "then": PPOConfig.before, "stock": None}
    for asked in options.by:
        name, equals, settings = asked.partition("=")
        kinds |= {name: json.loads(settings)} if equals else {}
    plan = []
    for spec in options.specs or PLAN:
        seeds, times = PLAN[spec]
        iterations = round(section_of(spec)[0]["iterations"] * (options.times or times))
        for by in (asked.partition("=")[0] for asked in options.by):
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
