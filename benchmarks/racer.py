"""Training time until a car drives laps, judged at intervals on held-out worlds; and cars · steps per second.

    python -m benchmarks.racer [--loaded-anyway]                                     # job_specs/racer.yaml, on a CPU
    python -m benchmarks.racer --task RacerPixels --worlds 1024 --seconds 1800       # job_specs/racer-pixels.yaml, on a GPU
    python -m benchmarks.racer --table                                               # the table alone, of all rows that are there

Task, tracks, action space and all other settings are those of the job's YAML; ``--train`` changes them. A policy is judged by its mean
action, one episode in each of ``--judged`` worlds, and drives when ``--share`` of them are complete laps; the training continues, since
laps become faster. The clock of training counts iterations like a job's, with reports and checkpoints; building the worlds, judging and
the clip are timed separately. Processor time is that of this process, which means more on a machine with other work. No network is
needed.

Writes ``racer-<task>-<device>.json``, the curve as ``.png`` where matplotlib is installed, a clip as ``.gif``, and ``racer.md`` of all rows.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import os
import statistics
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
import yaml

from benchmarks.load import Watch, add_option, reported
from benchmarks.peers.inside.clock import versions
from benchmarks.training import CUDA, build, device_name, rate, wait
from racer.settings.task import RacerConfig
from shared_store.volume.layout import Run
from worker.evaluation.evaluation import evaluate
from worker.learning.loop import Loop
from worker.learning.randomness import held_out_seed
from worker.learning.setup import build_task
from worker.settings.errors import UserError
from worker.tasks.run.adapting import adaptive_steps, begin_evaluation
from worker.tasks.run.task import Task

HERE = Path(__file__).parent
JOBS = {"Racer": "racer.yaml", "RacerPixels": "racer-pixels.yaml"}
REAL_TIME = 15.0
"""Control steps a second of a simulator that runs one car in real time, as DeepRacer's does (reward 15 images a second)."""
CLIP = (320, 240)
"""Size of a frame [px]."""


class RacingLoop(Loop):
    """A training that is judged at intervals."""

    def judged_by(self, worlds: Task, share: float, every: float, limit: float, iterations: int) -> RacingLoop:
        """Set up the judgement; call it before :meth:`train`.

        Args:
            worlds: Worlds in which policies are judged.
            share: Share of complete laps from which the policy counts as driving.
            every: Seconds of training between two judgements.
            limit: Seconds of training after which it ends in any case.
            iterations: Iterations after which it ends.
        """
        self._worlds, self._share, self._every, self._limit, self._last = worlds, share, every, limit, iterations
        self.curve: list[dict[str, Any]] = []
        """For each iteration: ``seconds`` and ``cpu_seconds`` of training, ``env_steps``, ``episodes``, ``laps``, ``progress``."""
        self.judged: list[dict[str, Any]] = []
        """For each judgement: the same times, ``share`` of complete laps, ``lap_times`` by track [s], causes of episodes' ends."""
        self.done: dict[str, Any] | None = None
        """The first judgement with that share."""
        self._apart, self._next, self._began = (0.0, 0.0), every, (time.perf_counter(), time.process_time())
        return self

    def train(self) -> int:
        """As :meth:`Loop.train`; the clock starts here."""
        wait()
        self._began = time.perf_counter(), time.process_time()
        return super().train()

    def _now(self) -> tuple[float, float]:
        """Seconds and processor seconds of training."""
        now = time.perf_counter(), time.process_time()
        return now[0] - self._began[0] - self._apart[0], now[1] - self._began[1] - self._apart[1]

    def _iterate(self) -> tuple[dict[str, Any], dict[str, float]]:
        record, signals = super()._iterate()
        seconds, cpu = self._now()
        at = {
            "seconds": seconds,
            "cpu_seconds": cpu,
            "env_steps": record["env_steps"],
            "iteration": record["iteration"],
        }
        found = {"episodes": record["episodes"], "laps": record["termination_lap_complete"]}
        self.curve.append(at | found | {"progress": record["metric_progress"], "reward": record["reward"]})
        over = seconds >= self._limit or record["iteration"] >= self._last
        if not self.stop.requested and (seconds >= self._next or over):
            wait()
            self._judge(at)
            wait()
            self._next = seconds + self._every
            spent = self._now()
            self._apart = self._apart[0] + spent[0] - seconds, self._apart[1] + spent[1] - cpu
            self._stopwatch.begin()  # the run's own records exclude it too
        self.stop.requested |= over  # it saves after the next iteration, then exits
        return record, signals

    def _judge(self, at: dict[str, Any]) -> None:
        begin_evaluation(self._worlds, at["iteration"] - 1, self.curve[-1]["reward"], None, adaptive_steps(self.task))
        played = evaluate(self._worlds, self.algorithm.policy(), self.gang, checkpoint="-").played
        laps, times, progress = played.successes, played.term("metric_lap_time"), played.term("metric_progress")
        assert laps is not None
        config = self._worlds.config
        assert isinstance(config, RacerConfig)
        share, count = laps.double().mean().item(), len(config.tracks)
        by_track = {
            name: [round(value, 3) for value in times[number::count][laps[number::count]].tolist()]
            for number, name in enumerate(config.tracks)
        }
        ends = played.ends
        row = at | {"share": share, "progress": progress.mean().item(), "lap_times": by_track}
        row["ends"] = {name: ends.count(name) for name in sorted(set(ends))}
        self.judged.append(row)
        if share >= self._share and self.done is None:
            self.done = row
        print(
            f"{at['seconds']:.1f} s, {at['env_steps']:,} steps: {100 * share:.1f} % complete laps, {row['ends']}",
            flush=True,
        )


def merged(base: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """A section with changes, merged mapping by mapping."""
    found = dict(base)
    for key, value in changes.items():
        both = isinstance(value, Mapping) and isinstance(found.get(key), Mapping)
        found[key] = merged(found[key], value) if both else value
    return found


def measure(options: argparse.Namespace, store: Path, clip: Path) -> dict[str, Any]:
    """Train once, and report when the policy drove laps. Writes the clip."""
    built = time.perf_counter()
    section = yaml.safe_load((HERE.parent / "job_specs" / JOBS[options.task]).read_text())["train"]
    section = merged(section, options.train)
    worlds = options.worlds or section["worlds"]
    iterations = options.iterations or section["iterations"]
    for name in ("task", "worlds", "seed"):
        section.pop(name, None)
    section["iterations"] = iterations + 100  # it exits earlier, without its own evaluation
    loop = build(options.task, worlds, store, options.seed, loop_type=RacingLoop, **section)
    assert isinstance(loop, RacingLoop)
    share = type(loop.share).of(0, 1, options.judged)
    judged = build_task(type(loop.task), loop.config, share, loop.gang, held_out_seed(options.seed))
    loop.judged_by(judged, options.share, options.every, options.seconds, iterations)
    wait()
    built = time.perf_counter() - built
    loop.train()
    took = [after["seconds"] - before["seconds"] for before, after in itertools.pairwise(loop.curve)]
    steps = worlds * loop.algorithm.steps
    row = {
        "task": options.task,
        "worlds": worlds,
        "seed": options.seed,
        "train": section,
        "image": [*loop.task.groups["policy"].shape[1:]] if options.task != "Racer" else None,
        "judged_worlds": options.judged,
        "wanted": options.share,
        "built_s": built,
        "done": loop.done,
        "training_rate": steps / statistics.median(took),
        "simulation_rate": simulation_rate(loop.task),
        "device": device_name(),
        "cuda": CUDA,
        "cores": os.cpu_count(),
        "versions": versions("muster", "newton", "warp-lang", "torch"),
        "judged": loop.judged,
        "curve": loop.curve,
    }
    run = loop.job.run
    loop.close()
    film(run, clip, options.clip_seconds)
    return row


def simulation_rate(task: Task) -> float:
    """Cars · steps per second without a policy, including the task's camera."""
    if task.discrete:
        actions = torch.randint(0, task.action_size, tuple(task.actions.shape), device=task.device)
    else:
        actions = torch.rand(tuple(task.actions.shape), device=task.device) * 2 - 1
    actions = actions.to(task.actions.dtype)
    return rate(lambda: task.step(actions), task.world_count)


def film(run: Run, path: Path, seconds: float) -> None:
    """One car of the last checkpoint, from the side."""
    from worker.telemetry import picture
    from worker.telemetry.rollout import Rollout

    rollout = Rollout.of(run, {}, 1)
    camera = picture.StageCamera(rollout.stage(rollout.task.device), *CLIP)
    stride, frames = picture.pace(rollout.config.control_hz, ".gif")
    steps = max(1, round(seconds * rollout.config.control_hz))
    taken = [camera.take(rows.coordinates[-1]) for rows in itertools.islice(rollout.steps(steps), 0, None, stride)]
    path.write_bytes(picture.encode(taken, ".gif", frames))


def first(row: Mapping[str, Any]) -> dict[str, Any] | None:
    """The first iteration in which a lap was completed."""
    return next((at for at in row["curve"] if at["laps"]), None)


def draw(row: Mapping[str, Any], path: Path) -> None:
    """Plot progress and complete laps against the time of training; do nothing without matplotlib."""
    try:
        import matplotlib
    except ImportError:
        return
    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, (left, right, last) = pyplot.subplots(1, 3, figsize=(12, 3))
    curve, judged = row["curve"], row["judged"]
    seconds = [at["seconds"] for at in curve]
    left.plot(seconds, [math.nan if at["progress"] is None else at["progress"] for at in curve], label="training")
    left.plot([at["seconds"] for at in judged], [at["progress"] for at in judged], marker="o", label="mean action")
    left.set_title("lap driven by an episode [%]")
    left.legend()
    right.plot([at["seconds"] for at in judged], [100 * at["share"] for at in judged], marker="o", color="tab:orange")
    right.set_title("complete laps, mean action [%]")
    if lap := first(row):
        for panel in (left, right):
            panel.axvline(lap["seconds"], color="tab:green", linestyle="--")
    for track in judged[0]["lap_times"]:
        means = [statistics.fmean(at["lap_times"][track] or [math.nan]) for at in judged]
        last.plot([at["seconds"] for at in judged], means, marker="o", label=track)
    last.set_title("mean lap time, mean action [s]")
    last.legend(fontsize="small")
    for panel in (left, right, last):
        panel.set_xlabel("seconds of training")
        panel.set_ylim(0, 105 if panel is not last else None)
        panel.grid(alpha=0.3)
    figure.suptitle(f"{row['task']}, {row['worlds']:,} cars, {where(row)}")
    figure.tight_layout()
    figure.savefig(path, dpi=100)
    pyplot.close(figure)


def where(row: Mapping[str, Any]) -> str:
    """The device of a row's measurement."""
    return str(row["device"]) if row["cuda"] else f"{row['cores']} CPU cores"


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Markdown."""
    lines = [
        "# How long until a car drives laps",
        "",
        "`python -m benchmarks.racer`: the jobs [racer.yaml](../job_specs/racer.yaml) and [racer-pixels.yaml](../job_specs/racer-pixels.yaml) from",
        "their first iteration on, one seed each. A lap is complete where the car came as far as the track is long without leaving it. Processor",
        "seconds are those of the training's process; building the worlds and judging stand apart.",
        "",
        "| task | on | cars | first complete lap | drives | in the end | complete laps then | training | simulation | × real time, one car |",
        "|---|---|--:|---|---|---|--:|--:|--:|--:|",
    ]
    requested = " or ".join(sorted({f"{100 * row['wanted']:g} %" for row in rows}))
    for row in rows:
        last = row["judged"][-1]
        lines.append(
            f"| {row['task']} | {where(row)} | {row['worlds']:,} | {_when(first(row))} | "
            f"{_when(row['done']) if row['done'] else 'no'} | {_when(last)} | {100 * last['share']:.1f} % | {row['training_rate']:,.0f} steps/s | {row['simulation_rate']:,.0f} cars · steps/s | "
            f"{row['simulation_rate'] / REAL_TIME:,.0f} |"
        )
    lines += [
        "",
        f"First complete lap: of any car in training, whose actions are drawn. Drives: {requested} of the judged episodes are complete laps, by the "
        "mean action on held-out worlds. DeepRacer's own simulator drives one car a process in real time, 15 control steps a second.",
    ]
    for row in rows:
        name = stem(row)
        lines += ["", f"## {row['task']}, {where(row)}", "", reported([dict(row)])]
        lines += ["", f"![progress and complete laps against time]({name}.png) ![a lap]({name}.gif)", ""]
        lines += [f"In the end, over {row['judged_worlds']} episodes:", ""]
        lines += ["| track | complete laps | best [s] | mean [s] |", "|---|--:|--:|--:|"]
        tracks = row["judged"][-1]["lap_times"]
        for number, (track, times) in enumerate(tracks.items()):
            driven = len(range(number, row["judged_worlds"], len(tracks)))
            figures = f"{min(times):.2f} | {sum(times) / len(times):.2f}" if times else "– | –"
            lines.append(f"| {track} | {len(times)} of {driven} | {figures} |")
    return "\n".join(lines) + "\n"


def _when(at: Mapping[str, Any] | None) -> str:
    if at is None:
        return "none"
    return f"{at['seconds']:.1f} s ({at['cpu_seconds']:.0f} s of processors), {at['env_steps'] / 1e6:.2f} M steps"


def stem(row: Mapping[str, Any]) -> str:
    """Name of a row's files."""
    return f"racer-{row['task'].lower()}-{'gpu' if row['cuda'] else 'cpu'}"


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.racer", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--task", choices=list(JOBS), default="Racer")
    parser.add_argument("--worlds", type=int, help="number of cars; by default the job's")
    parser.add_argument("--judged", type=int, default=64, help="worlds in which policies are judged")
    parser.add_argument(
        "--share", type=float, default=1.0, help="share of complete laps from which the policy counts as driving"
    )
    parser.add_argument("--iterations", type=int, help="iterations of training; by default the job's")
    parser.add_argument("--seconds", type=float, default=300.0, help="of training, at most")
    parser.add_argument("--every", type=float, default=5.0, help="seconds of training between two judgements")
    parser.add_argument("--clip-seconds", type=float, default=12.0, help="of the clip, simulated")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, default=HERE)
    parser.add_argument(
        "--table", action="store_true", help="write the table of the existing rows, and measure nothing"
    )
    parser.add_argument(
        "--train",
        type=json.loads,
        default={},
        help='more of the job\'s train section, as JSON: \'{"ppo": {"epochs": 3}}\'',
    )
    add_option(parser)
    options = parser.parse_args(arguments)
    for name in ("judged", "seconds", "every", "clip_seconds"):
        if getattr(options, name) <= 0:
            parser.error(f"--{name.replace('_', '-')} {getattr(options, name)}: it is more than 0")
    if not 0 < options.share <= 1:
        parser.error(f"--share {options.share}: it is more than 0 and at most 1")
    options.out.mkdir(parents=True, exist_ok=True)
    if not options.table:
        watch = Watch(options.loaded_anyway)
        with tempfile.TemporaryDirectory() as store:
            clip = Path(store) / "clip.gif"
            try:
                row = measure(options, Path(store), clip)
            except UserError as error:
                parser.error(str(error))
            (options.out / f"{stem(row)}.gif").write_bytes(clip.read_bytes())
        row |= watch.check(f"while {options.task} learnt to drive")
        (options.out / f"{stem(row)}.json").write_text(json.dumps(row))
        draw(row, options.out / f"{stem(row)}.png")
    found = [json.loads(path.read_text()) for path in sorted(options.out.glob("racer-*.json"))]
    if not found:
        parser.error(f"there are no rows in {options.out}")
    (options.out / "racer.md").write_text(table(found))
    print(f"written: {options.out / 'racer.md'}", flush=True)


if __name__ == "__main__":
    main()
