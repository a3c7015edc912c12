"""Wall time from the start of training until a robot walks: its policy follows commands and does not fall.

    python -m benchmarks.walking --task G1Flat --algorithm sac|ppo [--worlds 4096] [--seconds 600] [--out DIRECTORY]

A policy walks when, in a whole episode of each of ``--judged`` other worlds (drawn from another seed, with the task's own noise,
pushes and randomisation), the mean length of the episodes is at least ``--length`` of the longest and the mean tracking errors of its
mean actions are at most ``--linear`` and ``--angular``. Those worlds have the task's own physics steps and mjlab's limits of the solver,
whatever the training has (``--limits ours``, ``--train '{"config": {"substeps": 2}}'``). It is judged every ``--every`` seconds of
training, while the clock of training is paused; the time of judging is reported separately. The clock starts with the first iteration,
before any graph is captured; earlier work (imports, worlds, kernels) is reported separately, too. Training is that of ``muster run``,
with metrics and checkpoints.

Writes ``walking-<task>-<algorithm>-<seed>.json`` and the curve as ``.png`` where matplotlib is installed.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch

from benchmarks.load import Watch, add_option
from benchmarks.peers.building import build_loop
from benchmarks.peers.cases import CASES
from benchmarks.peers.inside.clock import versions
from benchmarks.peers.judging import Judgement, VelocityErrors, judge
from benchmarks.training import device_name, wait
from shared_store.contract.error_text import nearest
from worker.learning.loop import Loop
from worker.learning.randomness import held_out_seed
from worker.tasks.run.adapting import adaptive_steps, begin_evaluation
from worker.tasks.run.task import Task

ALGORITHMS = ("sac", "ppo")
LENGTH = 0.987
"""Share of the longest episode: 987 of 1,000 steps, as in the public records of G1."""
LINEAR, ANGULAR = 0.3, 0.4
"""Tracking errors of a robot that follows its commands [m/s, rad/s]: commands reach 1 m/s and 0.5 rad/s, and pushes of up to 0.5 m/s
come every 1 to 3 s."""

PHYSICS = ("substeps", "solver_iterations", "solver_line_search")
"""Settings in which a training's physics may be coarser than its judgement's."""


@dataclass(frozen=True)
class Bounds:
    """Criteria of walking.

    Attributes:
        length: Least mean length of an episode, as a share of the longest.
        linear: Greatest mean error of the velocity in the plane [m/s].
        angular: Greatest mean error of the turning velocity [rad/s].
    """

    length: float = LENGTH
    linear: float = LINEAR
    angular: float = ANGULAR

    def met(self, found: Judgement) -> bool:
        """Whether it walks."""
        return (
            found.length_share >= self.length
            and found.linear_error <= self.linear
            and found.angular_error <= self.angular
        )


class WalkingLoop(Loop):
    """A training that is judged at intervals, and ends once its policy walks."""

    def judged_by(self, worlds: Task, bounds: Bounds, every: float, limit: float) -> WalkingLoop:
        """Set up the judgement; call it before :meth:`train`.

        Args:
            worlds: Worlds in which policies are judged.
            bounds: Criteria of walking.
            every: Seconds of training between two judgements.
            limit: Seconds of training after which it ends in any case.
        """
        self._worlds, self._bounds, self._every, self._limit = worlds, bounds, every, limit
        self.curve: list[dict[str, Any]] = []
        """One row per judgement: ``seconds`` of training, ``env_steps``, ``iteration``, and the fields of :class:`Judgement`."""
        self.walked: dict[str, Any] | None = None
        """The first row of a policy that walks."""
        self.judging = 0.0
        """Total seconds of all judgements, which the clock of training excludes."""
        self._next, self._began = every, 0.0
        return self

    @property
    def trained(self) -> float:
        """Seconds of training so far."""
        return time.perf_counter() - self._began - self.judging

    def train(self) -> int:
        """As :meth:`Loop.train`; the clock starts here."""
        wait()
        self._began = time.perf_counter()
        return super().train()

    def _handle(self, signals: dict[str, float]) -> bool:
        left = super()._handle(signals)
        wait()
        if not left and self.walked is None and (self.trained >= self._next or self.trained >= self._limit):
            self._judge()
        if self.walked is not None or self.trained >= self._limit:
            self.stop.requested = True  # it saves after the next iteration, then exits
        return left

    def _judge(self) -> None:
        seconds, started = self.trained, time.perf_counter()
        progress = self.state.progress
        reported = progress.iteration - 1, progress.reward, progress.episode_length
        begin_evaluation(self._worlds, *reported, adaptive_steps(self.task))
        judged = judge(self._worlds, self.algorithm.policy())
        row = {"seconds": seconds, "env_steps": progress.env_steps, "iteration": progress.iteration} | asdict(judged)
        self.curve.append(row)
        if self._bounds.met(judged):
            self.walked = row
        self._next = seconds + self._every
        wait()
        self.judging += time.perf_counter() - started
        self._stopwatch.begin()  # the run's own records exclude it too
        print(
            f"{seconds:.1f} s: length {100 * judged.length_share:.1f} %, linear {judged.linear_error:.3f} m/s, angular "
            f"{judged.angular_error:.3f} rad/s (judged in {judged.judging_s:.1f} s)",
            flush=True,
        )


def judged_with(config: Any) -> Any:
    """The training's configuration with the task's default physics: its physics steps and its limits of the solver."""
    usual = type(config)()
    return dataclasses.replace(config, **{name: getattr(usual, name) for name in PHYSICS})


def walk(options: argparse.Namespace, seed: int, store: Path) -> dict[str, Any]:
    """Train once, and report when the policy walked. Raises ValueError if the task can't be judged."""
    built = time.perf_counter()
    requested = {
        "task": options.task,
        "worlds": options.worlds,
        "iterations": options.iterations,
        "limits": next(case.limits(options.limits) for case in CASES.values() if case.task == options.task).__dict__,
        "save_every": options.save_every,
        "seed": seed,
    }
    loop = build_loop(requested, store, WalkingLoop, algorithm=options.algorithm, **options.train)
    assert isinstance(loop, WalkingLoop)
    own = type(loop.task)
    worlds = own(judged_with(loop.config), options.judged, seed=held_out_seed(seed), device=loop.gang.device)
    VelocityErrors(worlds)
    bounds = Bounds(options.length, options.linear, options.angular)
    loop.judged_by(worlds, bounds, options.every, options.seconds)
    wait()
    built = time.perf_counter() - built
    loop.train()
    trained, record = loop.trained, loop.curve
    loop.close()
    return {
        "task": options.task,
        "algorithm": options.algorithm,
        "train": options.train,
        "worlds": options.worlds,
        "seed": seed,
        "limits": options.limits,
        "solver": dict(loop.task.solver_options),
        "bounds": asdict(bounds),
        "judged_worlds": options.judged,
        "built_s": built,
        "walked": loop.walked,
        "trained_s": trained,
        "judging_s": loop.judging,
        "device": device_name(),
        "versions": versions("muster", "newton", "mujoco-warp", "warp-lang", "torch"),
        "curve": record,
    }


def verdict(row: dict[str, Any]) -> str:
    """One sentence."""
    bounds = row["bounds"]
    meant = (
        f"length >= {100 * bounds['length']:.1f} %, errors <= {bounds['linear']:g} m/s and {bounds['angular']:g} rad/s"
    )
    apart = f"judging took {row['judging_s']:.1f} s more, building {row['built_s']:.1f} s before"
    what = f"{row['task']} with {row['algorithm']}, seed {row['seed']}, on {row['device']}"
    if row["walked"] is None:
        return f"{what}: it does not walk after {row['trained_s']:.1f} s ({meant}); {apart}"
    at = row["walked"]
    return f"{what}: walks after {at['seconds']:.1f} s and {at['env_steps'] / 1e6:.1f} M steps ({meant}); {apart}"


def draw(row: dict[str, Any], path: Path) -> None:
    """Plot lengths and errors against the time of training, with their bounds; do nothing without matplotlib."""
    try:
        import matplotlib
    except ImportError:
        return
    matplotlib.use("Agg")
    from matplotlib import pyplot

    shown = {
        "length_share": ("length", "share"),
        "linear_error": ("linear", "m/s"),
        "angular_error": ("angular", "rad/s"),
    }
    figure, panels = pyplot.subplots(1, len(shown), figsize=(4 * len(shown), 3))
    seconds = [point["seconds"] for point in row["curve"]]
    for panel, (key, (bound, unit)) in zip(panels, shown.items(), strict=True):
        panel.plot(seconds, [point[key] for point in row["curve"]], marker=".")
        panel.axhline(row["bounds"][bound], color="tab:gray", linestyle="--")
        if row["walked"]:
            panel.axvline(row["walked"]["seconds"], color="tab:green")
        panel.set_title(f"{key.replace('_', ' ')} [{unit}]")
        panel.set_xlabel("seconds of training")
    figure.suptitle(f"{row['task']}, {row['algorithm']}, {row['worlds']:,} worlds, {row['device']}")
    figure.tight_layout()
    figure.savefig(path, dpi=100)
    pyplot.close(figure)


def check(options: argparse.Namespace) -> None:
    """Raises ValueError for invalid options."""
    tasks = [case.task for case in CASES.values() if "mjlab" in case.peers]
    if options.task not in tasks:
        raise ValueError(f"--task {options.task}: it follows no velocity commands; {nearest(options.task, tasks)}")
    if options.algorithm not in ALGORITHMS:
        raise ValueError(f"--algorithm {options.algorithm}: there are {' and '.join(ALGORITHMS)}")
    if options.limits not in ("theirs", "ours"):
        raise ValueError(f"--limits {options.limits}: there are theirs and ours")
    for name in ("worlds", "judged", "seconds", "every", "linear", "angular", "save_every", "iterations"):
        if getattr(options, name) <= 0:
            raise ValueError(f"--{name.replace('_', '-')} {getattr(options, name)}: it is more than 0")
    if not 0 < options.length <= 1:
        raise ValueError(f"--length {options.length}: it is a share of the longest episode, more than 0 and at most 1")


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.walking",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--task", default="G1Flat")
    parser.add_argument("--algorithm", default="ppo", help=" or ".join(ALGORITHMS))
    parser.add_argument("--limits", default="theirs", help="of the solver: theirs (mjlab's), or ours")
    parser.add_argument("--worlds", type=int, default=4096)
    parser.add_argument("--judged", type=int, default=256, help="worlds in which policies are judged")
    parser.add_argument("--seconds", type=float, default=600.0, help="of training, at most")
    parser.add_argument("--iterations", type=int, default=10**6, help="of training, at most")
    parser.add_argument("--every", type=float, default=5.0, help="seconds of training between two judgements")
    parser.add_argument("--save-every", type=int, default=50, help="iterations between two checkpoints")
    parser.add_argument("--length", type=float, default=LENGTH)
    parser.add_argument("--linear", type=float, default=LINEAR, help="greatest error [m/s]")
    parser.add_argument("--angular", type=float, default=ANGULAR, help="greatest error [rad/s]")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--out", type=Path, default=Path(__file__).parent)
    parser.add_argument(
        "--train",
        type=json.loads,
        default={},
        help='more of the job\'s train section, as JSON: \'{"sac": {"updates": 32}}\'',
    )
    add_option(parser)
    options = parser.parse_args(arguments)
    try:
        check(options)
    except ValueError as error:
        parser.error(str(error))
    options.out.mkdir(parents=True, exist_ok=True)
    watch = Watch(options.loaded_anyway)
    for seed in options.seeds:
        with tempfile.TemporaryDirectory() as store:
            row = walk(options, seed, Path(store))
        row |= watch.check(f"while {options.task} learnt to walk")
        path = options.out / f"walking-{options.task.lower()}-{options.algorithm}-{seed}.json"
        path.write_text(json.dumps(row, indent=1))
        draw(row, path.with_suffix(".png"))
        print(verdict(row), flush=True)
        if torch.cuda.is_available():
            torch.cuda.empty_cache()


if __name__ == "__main__":
    main()
