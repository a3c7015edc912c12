"""Cost of observing a policy, and speed of evaluating and exporting it: tap, recordings, evaluation, rendering, export, on this device.

    python -m benchmarks.seeing [--tasks Cartpole Ant] [--out DIRECTORY]

Each training has three stretches of equal length: ``muster record`` writes four of its worlds; no reader is attached; ``muster view``
shows the worlds (without a browser, and only where Rerun is installed). A second training with the same seed and no reader repeats the
iterations for comparison, since an iteration's duration changes as robots learn. The checkpoint is then recorded, evaluated and exported.
Writes ``seeing.md``.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import signal
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from importlib.util import find_spec
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch

from benchmarks.load import Watch, add_option, reported
from benchmarks.training import CUDA, build, device_name
from shared_store.volume.layout import Run
from shared_store.volume.metrics import read_metrics
from worker.evaluation.episodes import SIZE, Blocks, play
from worker.export import export
from worker.learning.distributed import RankPlacement, connect
from worker.learning.loop import Loop
from worker.learning.trained import load_policy
from worker.telemetry.picture import StageCamera
from worker.telemetry.recording import Recording
from worker.telemetry.rollout import Rollout

WORLDS = {"Cartpole": 4096, "Ant": 4096, "CartpolePixels": 1024, "Humanoid": 4096, "Quadruped": 4096}
WORLDS_CPU = {"Cartpole": 1024, "Ant": 64}
WARM, STRETCH, ROUNDS = 8, 40 if CUDA else 20, 3
CHANGES = ("recorded", "left", "viewed")
TAPPED, EPISODES = 4, 2
"""Number of recorded worlds, and of episodes of each in a checkpoint's recording."""
PICTURES = 60
JUDGED = 256
"""Worlds of the evaluation: blocks of 32 act one after the other, so that its rate is the same with more of them."""


def watched(loop: Loop) -> list[int]:
    """Train with a recording, then without a reader, then with a live view; returns the iterations at which each stretch begins and ends."""
    run, marks, failed = loop.job.run, list[int](), list[str]()

    def done() -> int:
        return int(loop.state.progress.iteration)

    def wait(iterations: int) -> None:
        goal = done() + iterations
        while done() < goal:
            time.sleep(0.05)

    def mark(iterations: int) -> None:
        marks.append(done())
        wait(iterations)
        marks.append(done())

    def attended(is_ready: Callable[[], bool], output: Path, *command: str) -> None:
        with output.open("w") as stream:
            reader = subprocess.Popen([sys.executable, "-m", *command], stdout=stream, stderr=subprocess.STDOUT)
        while not is_ready():  # its imports and construction take seconds of processor time
            if reader.poll() is not None:
                raise RuntimeError(f"{command[0]} ended at once:\n{output.read_text()}")
            time.sleep(0.05)
        wait(WARM)  # the rollout was captured anew
        mark(STRETCH)
        reader.send_signal(signal.SIGINT)
        reader.wait()
        wait(WARM)

    def look_on(folder: Path) -> None:
        try:
            look(folder)
        except RuntimeError as error:
            failed.append(str(error))
        loop.stop.requested = True

    def look(folder: Path) -> None:
        wait(WARM)
        worlds = ("--worlds", str(TAPPED))
        made, output = folder / "live.mcap", folder / "output.txt"
        options = ("--episodes", "1000000", "--output", str(made))
        recorded = ("worker.telemetry.live_recording", str(run.path), *worlds, *options)
        attended((folder / "live.mcap.partial").exists, output, *recorded)
        mark(STRETCH)
        if find_spec("rerun"):
            viewed = ("worker.telemetry.live_view", "--training", str(run.path), "--job", "bench", *worlds)
            attended(lambda: "http://" in output.read_text(), output, *viewed)

    with tempfile.TemporaryDirectory() as folder:
        watcher = threading.Thread(target=look_on, args=(Path(folder),))
        watcher.start()
        with contextlib.redirect_stdout(io.StringIO()):
            loop.train()
        watcher.join()
    if failed:
        raise SystemExit(failed[0])
    return marks


def took(run: Run, marks: list[int]) -> list[float]:
    """Median milliseconds of an iteration between consecutive marks."""
    ends = [record["total_seconds"] for record in read_metrics(run)]
    each = [1000 * (after - before) for before, after in pairwise(ends)]
    return [statistics.median(each[first:last]) for first, last in zip(marks[::2], marks[1::2], strict=True)]


def recorded(run: Run, folder: Path) -> dict[str, float]:
    """Control steps a second of a checkpoint's recording, and bytes of a simulated minute of it."""
    with contextlib.redirect_stdout(io.StringIO()):
        rollout = Rollout.of(run, {}, TAPPED)
        recording = Recording(folder / "a.mcap", rollout.stage(), rollout.facts(), rollout.attachments())
        most, started = EPISODES * rollout.task.max_episode_length, time.perf_counter()
        for rows in rollout.steps(most):
            recording.write(rows)
            if recording.complete(EPISODES):
                break
        recording.finish()
    seconds = time.perf_counter() - started
    minutes = recording.steps / rollout.config.control_hz / 60
    return {"record_rate": recording.steps / seconds, "minute": (folder / "a.mcap").stat().st_size / minutes}


def judged(run: Run, worlds: int) -> dict[str, float]:
    """Policy steps and episodes a second of an evaluation in at most as many worlds as the training has."""
    count = -(-min(worlds, JUDGED) // SIZE) * SIZE
    rollout = Rollout.of(run, {}, count)
    policies = [load_policy(rollout.checkpoint, str(rollout.task.device)) for _ in range(count // SIZE)]
    gang = connect(RankPlacement())
    best: dict[str, float] = {}
    for _ in range(2):  # the first step captures the graph
        started = time.perf_counter()
        played = play([rollout.task], Blocks(policies), gang)
        if CUDA:
            torch.cuda.synchronize()
        seconds = time.perf_counter() - started
        # all worlds step until the longest episode ends
        steps = float(played.lengths.max()) * count
        best = {
            "judged": count,
            "evaluation_rate": steps / seconds,
            "episodes": count / seconds,
            "length": float(played.lengths.mean()),
        }
    gang.close()
    return best


def rendered(run: Run) -> dict[str, float]:
    """Pictures per second of the camera of ``muster render``, 640 x 360 px, without the first, which loads kernels."""
    rollout = Rollout.of(run, {}, TAPPED)
    camera, spent = StageCamera(rollout.stage(rollout.task.device), 640, 360), list[float]()
    for rows in rollout.steps(PICTURES + 1):
        started = time.perf_counter()
        camera.take(rows.coordinates[-1])
        spent.append(time.perf_counter() - started)
    return {"rendered": PICTURES / sum(spent[1:])}


def exported(run: Run) -> dict[str, float]:
    """Seconds of an export with its judgement, 16 episodes."""
    rollout = Rollout.of(run, {}, 16)
    started = time.perf_counter()
    with contextlib.redirect_stdout(io.StringIO()):
        export(run, rollout.checkpoint, rollout.task)
    return {"export": time.perf_counter() - started}


def measure(task: str, worlds: int) -> dict[str, Any]:
    """All measurements of one task."""
    rounds, row = list[tuple[list[float], list[float]]](), dict[str, Any]()
    for number in range(ROUNDS):
        with tempfile.TemporaryDirectory() as store, tempfile.TemporaryDirectory() as other:
            loop = build(task, worlds, Path(store), every=1000)
            marks, run = watched(loop), loop.job.run
            steps = worlds * loop.algorithm.steps
            loop.close()
            twin = build(task, worlds, Path(other), every=1000, iterations=marks[-1] + 1)
            with contextlib.redirect_stdout(io.StringIO()):
                twin.train()
            rounds.append((took(run, marks), took(twin.job.run, marks)))
            twin.close()
            if number == ROUNDS - 1:
                row = {**recorded(run, Path(store)), **judged(run, worlds), **rendered(run), **exported(run)}
    alone = statistics.median(unseen[0] for _, unseen in rounds)
    parts = range(len(rounds[0][0]))
    ratios = [statistics.median(seen[part] / unseen[part] for seen, unseen in rounds) - 1.0 for part in parts]
    shown = {"task": task, "worlds": worlds, "iteration": alone, **dict(zip(CHANGES, ratios, strict=False))}
    return {**shown, "training_rate": 1000 * steps / alone, **row}


def table(rows: list[dict[str, Any]]) -> str:
    """Markdown."""
    lines = [
        f"# What looking at a policy costs, on {device_name()}",
        "",
        f"`python -m benchmarks.seeing`; medians of {ROUNDS} pairs of trainings with the same seed; of one, `muster record` writes {TAPPED} "
        f"worlds for {STRETCH} iterations, no reader follows for as many, then `muster view` shows them. {reported(rows)}",
        "",
        "| task | worlds | an iteration without a reader [ms] | while worlds are recorded | after that | in the live view |",
        "|---|--:|--:|--:|--:|--:|",
    ]
    for row in rows:
        changes = " | ".join(f"{row[name]:+.1%}" if name in row else "-" for name in CHANGES)
        lines.append(f"| {row['task']} | {row['worlds']:,} | {row['iteration']:.1f} | {changes} |")
    lines += [
        "",
        "Of its checkpoint:",
        "",
        f"| task | recording of {TAPPED} worlds [control steps/s] | a simulated minute | training [steps/s] | worlds of the evaluation | its rate "
        "[steps/s] | episodes/s | their mean length [steps] | rendering, 640 x 360 px [pictures/s] | export, judged on 16 episodes [s] |",
        "|---|--:|--:|--:|--:|--:|--:|--:|--:|--:|",
    ]
    lines += [
        f"| {row['task']} | {row['record_rate']:,.0f} | {row['minute'] / 1e6:.1f} MB | {row['training_rate']:,.0f} | {row['judged']} | "
        f"{row['evaluation_rate']:,.0f} | {row['episodes']:,.0f} | {row['length']:,.0f} | {row['rendered']:,.0f} | {row['export']:.1f} |"
        for row in rows
    ]
    return "\n".join(lines) + "\n"


def main() -> None:
    worlds = WORLDS if CUDA else WORLDS_CPU
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="+", default=list(worlds), choices=list(worlds))
    parser.add_argument("--out", type=Path, default=Path(__file__).parent)
    add_option(parser)
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    watch, rows = Watch(options.loaded_anyway), list[dict[str, Any]]()
    for task in options.tasks:
        rows.append(measure(task, worlds[task]) | watch.check(f"while {task} was measured"))
        (options.out / "seeing.md").write_text(table(rows))
    print(table(rows))


if __name__ == "__main__":
    main()
