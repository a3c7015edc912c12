"""Cost of the parts of a task on this device: kernels, sensors, terms, and compilation.

    python -m benchmarks.tasks [--tasks Ant Quadruped] [--worlds 4096] [--no-compile] [--out DIRECTORY]

A part is captured many times in one graph, and its share is relative to one control step of the same task. All graphs take turns, so that
other load on the machine affects all of them. A sensor that the task lacks is added, and nothing reads it. A term's cost is the
difference to a task with sixteen more of them. Compilation runs in separate processes, with a kernel cache that is empty (cold) and then
full (warm). Writes ``tasks.md`` on a GPU and ``tasks_cpu.md`` without one.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import io
import json
import os
import re
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import torch
import warp as wp

from benchmarks.load import Watch, add_option, reported
from benchmarks.training import CUDA, device_name, wait
from worker.simulation.capture import CapturedStep
from worker.simulation.episodes import STEP
from worker.simulation.sensors.camera import CameraSensor
from worker.simulation.sensors.contact import ContactSensor
from worker.simulation.sensors.frames import Frames
from worker.simulation.sensors.height_scan import HeightScan
from worker.simulation.sensors.imu import Imu
from worker.simulation.sensors.momentum import AngularMomentum
from worker.simulation.sensors.rays import LidarPattern, RayCaster
from worker.tasks import find_task, terms
from worker.tasks.compile.compiler import Kernels
from worker.tasks.declare.declaration import Declaration, Metric, Observation
from worker.tasks.run.task import Task

WORLDS, WORLDS_CPU = 4096, 32
TASKS = ("Ant", "Quadruped")
FEET = {"Ant": "*_foot", "Quadruped": "*_shank", "LiftCube": "?f_down"}
"""Bodies that carry the sensors."""
TRUNKS = {"Ant": "torso", "Quadruped": "trunk", "LiftCube": "link_6"}
ROUNDS, SECONDS, COPIES = 9, 0.15, 20
MORE = 16
"""Number of additional terms."""
DEVICE = "cuda:0" if CUDA else "cpu"
LOADED = re.compile(r"^Module (\S+) \S+ load on device '.*' took ([\d.]+) ms", re.M)


def sensors(task: str) -> dict[str, Any]:
    """One of each kind, by its name in the table."""
    feet, trunk = FEET[task], TRUNKS[task]
    return {
        "contacts": ContactSensor(bodies=feet),
        "frames": Frames(bodies=feet),
        "imu": Imu(body=trunk),
        "momentum": AngularMomentum(),
        "heights": HeightScan(bodies=trunk),
    }


def eyes(task: str) -> dict[str, Any]:
    """What follows rays, which costs so much more that it is measured by itself alone."""
    trunk = TRUNKS[task]
    return {
        "rays_64": RayCaster(body=trunk, pattern=LidarPattern(count=64), start=0.5),
        "depth_64x64": CameraSensor(body=trunk, kind="depth", width=64, height=64),
        "colour_64x64": CameraSensor(body=trunk, width=64, height=64),
    }


def varied(task: str, change: Callable[[Declaration], Declaration]) -> type[Task]:
    """The task with another declaration."""
    kind: Any = find_task(task)
    return type(f"{task}Varied", (kind,), {"declare": lambda self, config: change(kind.declare(self, config))})


def made(kind: Any, worlds: int) -> Task:
    """A task with random actions; Warp's messages about its modules are not shown."""
    with contextlib.redirect_stdout(io.StringIO()):
        task: Task = kind(kind.config_type(), worlds, seed=1, device=DEVICE)
    task.actions.uniform_(-1.0, 1.0)
    return task


def parts(task: Task) -> dict[str, Callable[[], None]]:
    """The launches of a control step besides the physics."""
    control = task._control

    def kernel(kernel: wp.Kernel, inputs: list[Any]) -> Callable[[], None]:
        return lambda: wp.launch(kernel, dim=task.world_count, inputs=inputs, device=task.device)

    return {
        "actions": kernel(control.kernels.act, control.common),
        "judge": kernel(control.kernels.judge, control.inputs(int(STEP))),
        "observe": lambda: control.observe(int(STEP)),
        "bodies": task.worlds.update_bodies,
    }


def judged_and_observed(task: Task) -> Callable[[], None]:
    """The launches of a control step that hold terms."""
    own = parts(task)

    def launch() -> None:
        own["judge"]()
        own["observe"]()

    return launch


def measured(sensor: Any) -> Callable[[], None]:
    """A control step's launches of a sensor."""

    def launch() -> None:
        sensor.advance()
        sensor.settle()

    return launch


@contextlib.contextmanager
def unmeasured(sensed: Task, plain: Task) -> Iterator[None]:
    """In this context, a task runs only the sensors of the plain one."""
    sensors, needs = sensed.sensors, sensed._control.needs
    sensed.sensors, sensed._control.needs = {key: sensors[key] for key in plain.sensors}, plain._control.needs
    try:
        yield
    finally:
        sensed.sensors, sensed._control.needs = sensors, needs


def seconds(graphs: Mapping[str, Callable[[], None]]) -> dict[str, list[float]]:
    """Time of one replay of each graph in each round; the graphs take turns."""
    counts, found = {}, dict[str, list[float]]()
    for name, launch in graphs.items():
        launch()
        wait()
        started = time.perf_counter()
        launch()
        wait()
        counts[name] = max(1, round(SECONDS / max(1e-6, time.perf_counter() - started)))
    for _ in range(ROUNDS):
        for name, launch in graphs.items():
            started = time.perf_counter()
            for _ in range(counts[name]):
                launch()
            wait()
            found.setdefault(name, []).append((time.perf_counter() - started) / counts[name])
    return found


def copies(part: Callable[[], None]) -> Callable[[], None]:
    """A graph that holds a part many times."""

    def launch() -> None:
        for _ in range(COPIES):
            part()

    return CapturedStep(launch, DEVICE).launch


def more(name: str, declaration: Declaration) -> Declaration:
    """A declaration with sixteen more terms of a kind."""
    if name == "observation of each joint, with noise":
        policy = dict(declaration.groups["policy"])
        policy |= {f"more_{each}": Observation(terms.joint_velocity, noise=0.1, unit="rad/s") for each in range(MORE)}
        return dataclasses.replace(declaration, observations={**declaration.groups, "policy": policy})
    function = terms.joint_effort_squared if name == "reward of each joint" else terms.root_height
    metrics = {f"more_{each}": Metric(function) for each in range(MORE)}
    return dataclasses.replace(declaration, metrics={**declaration.metrics, **metrics})


TERMS = ("reward of the root", "reward of each joint", "observation of each joint, with noise")


def measure(name: str, worlds: int) -> dict[str, Any]:
    """Seconds of a control step and of its parts, of each sensor, of a term."""
    plain = made(find_task(name), worlds)

    def with_sensors(added: dict[str, Any]) -> Task:
        change = lambda supplied: dataclasses.replace(supplied, sensors={**supplied.sensors, **added})  # noqa: E731
        return made(varied(name, change), worlds)

    added, looking = sensors(name), eyes(name)
    sensed, seeing = with_sensors(added), with_sensors(looking)
    graphs: dict[str, Callable[[], None]] = {"step": CapturedStep(plain._control.whole, DEVICE).launch}
    # both on the same worlds, since the solver's work depends on their state
    graphs["step, sensed"] = CapturedStep(sensed._control.whole, DEVICE).launch
    with unmeasured(sensed, plain):
        graphs["step, unmeasured"] = CapturedStep(sensed._control.whole, DEVICE).launch
    graphs |= {part: copies(launch) for part, launch in parts(plain).items()}
    graphs |= {f"sensor {key}": copies(measured(sensed.sensors[key])) for key in added}
    graphs |= {f"sensor {key}": copies(measured(seeing.sensors[key])) for key in looking}
    for term in TERMS:
        crowd = made(varied(name, partial(more, term)), worlds)
        graphs[f"term {term}"] = copies(judged_and_observed(crowd))
    graphs["term none"] = copies(judged_and_observed(plain))
    found = seconds(graphs)
    times = {
        key: statistics.median(values) / (1 if key.startswith("step") else COPIES) for key, values in found.items()
    }
    pairs = zip(found["step, sensed"], found["step, unmeasured"], strict=True)
    times["sensors"] = statistics.median(more - less for more, less in pairs)
    for term in TERMS:
        pairs = zip(found[f"term {term}"], found["term none"], strict=True)
        times[f"term {term}"] = statistics.median(more - less for more, less in pairs) / COPIES / MORE
    started = time.perf_counter()
    Kernels(plain.plan, plain._control.needs.apart)
    columns = {key: len(sensed.sensors[key].names) for key in added}
    return {"times": times, "text": time.perf_counter() - started, "columns": columns, "eyes": [*looking]}


def compiled(name: str, worlds: int) -> dict[str, Any]:
    """Seconds until a task is built in a new process, and those for its own kernels and for all kernels, cold and warm."""
    found = {}
    with tempfile.TemporaryDirectory() as cache:
        for state in ("cold", "warm"):
            command = [sys.executable, "-m", "benchmarks.tasks", "--build", name, str(worlds)]
            environment = os.environ | {"WARP_CACHE_PATH": cache}
            output = subprocess.run(command, env=environment, check=True, stdout=subprocess.PIPE, text=True).stdout
            loads = [(module, float(took) / 1000) for module, took in LOADED.findall(output)]
            found[state] = {
                "own": sum(took for module, took in loads if module.startswith("muster.")),
                "all": sum(took for _, took in loads),
                "built": float(output.rstrip().rsplit("\n", 1)[-1]),
            }
    return found


def build(name: str, worlds: int) -> None:
    """Build a task, and print the time it took in the last line."""
    kind: Any = find_task(name)
    started = time.perf_counter()
    kind(kind.config_type(), worlds, seed=1, device=DEVICE)
    wait()
    print(time.perf_counter() - started)


def table(rows: list[dict[str, Any]]) -> str:
    """Markdown."""
    lines = [
        f"# What tasks are made of, on {device_name()}",
        "",
        f"Medians of {ROUNDS} rounds in which all graphs take turns; `python -m benchmarks.tasks`. {reported(rows)}",
        "",
        "## A control step",
        "",
        "`judge` rewards, ends, resets and, where nothing of bodies or sensors is observed, observes; else `observe` does, which also "
        "looks for what is not finite. Body poses are brought up to date only where a term or a sensor reads them.",
        "",
        "| task | worlds | step [ms] | actions | judge | observe | physics and the rest | body poses would add |",
        "|---|--:|--:|--:|--:|--:|--:|--:|",
    ]
    for row in rows:
        times, step = row["times"], row["times"]["step"]
        known = [times[part] / step for part in ("actions", "judge", "observe")]
        cells = " | ".join(f"{share:.2%}" for share in (*known, 1.0 - sum(known)))
        lines.append(
            f"| {row['task']} | {row['worlds']:,} | {1000 * step:.3f} | {cells} | {times['bodies'] / step:+.2%} |"
        )
    lines += [
        "",
        "## Sensors",
        "",
        "Each by itself, measured once a control step; a contact sensor that is `fine` takes its cost in every physics step. Those that "
        "look at bodies need their poses as well. All of them: the step with them, poses included, less the step without. Those that "
        "follow rays come after them, and are not among them.",
        "",
        "| task | sensor | columns | [µs] | of a step |",
        "|---|---|--:|--:|--:|",
    ]
    for row in rows:
        times, step = row["times"], row["times"]["step"]
        for key, columns in row["columns"].items():
            took = times[f"sensor {key}"]
            lines.append(f"| {row['task']} | {key} | {columns} | {1e6 * took:.1f} | {took / step:.2%} |")
        took = times["sensors"]
        lines.append(
            f"| {row['task']} | all of them | {sum(row['columns'].values())} | {1e6 * took:.1f} | {took / step:+.2%} |"
        )
        for key in row["eyes"]:
            took = times[f"sensor {key}"]
            lines.append(f"| {row['task']} | {key} | | {1e6 * took:.1f} | {took / step:.2%} |")
    lines += [
        "",
        "## A term",
        "",
        f"The kernels that judge and observe with {MORE} more terms, less those without, for one term.",
        "",
        "| task | one more | [µs] | of a step |",
        "|---|---|--:|--:|",
    ]
    for row in rows:
        times, step = row["times"], row["times"]["step"]
        for term in TERMS:
            took = times[f"term {term}"]
            lines.append(f"| {row['task']} | {term} | {1e6 * took:.2f} | {took / step:+.3%} |")
    return "\n".join([*lines, *compilation([row for row in rows if "compiled" in row])]) + "\n"


def compilation(rows: list[dict[str, Any]]) -> list[str]:
    """The part of the table about compilation."""
    if not rows:
        return []
    lines = [
        "",
        "## Compiling",
        "",
        "In a new process, after imports: the text of the task's own kernels; loading its own module; loading all modules, the solver's "
        "and the sensors' among them; until the task is there. Cold: with an empty kernel cache.",
        "",
        "| task | text [ms] | own module, cold [s] | warm | all modules, cold [s] | warm | task is there, cold [s] | warm |",
        "|---|--:|--:|--:|--:|--:|--:|--:|",
    ]
    for row in rows:
        pairs = [(row["compiled"]["cold"][key], row["compiled"]["warm"][key]) for key in ("own", "all", "built")]
        cells = " | ".join(f"{cold:.1f} | {warm:.2f}" for cold, warm in pairs)
        lines.append(f"| {row['task']} | {1000 * row['text']:.1f} | {cells} |")
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="+", default=list(TASKS), choices=list(FEET))
    parser.add_argument("--worlds", type=int, default=WORLDS if CUDA else WORLDS_CPU)
    parser.add_argument("--no-compile", action="store_true", help="leave out the compile times, which take minutes")
    parser.add_argument("--build", nargs=2, metavar=("TASK", "WORLDS"), help=argparse.SUPPRESS)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent)
    add_option(parser)
    options = parser.parse_args()
    if options.build:
        build(options.build[0], int(options.build[1]))
        return
    torch.manual_seed(1)
    watch, rows = Watch(options.loaded_anyway), list[dict[str, Any]]()
    file = options.out / ("tasks.md" if CUDA else "tasks_cpu.md")
    for task in options.tasks:
        row = {"task": task, "worlds": options.worlds} | measure(task, options.worlds)
        rows.append(row | watch.check(f"while {task} was measured"))
        file.write_text(table(rows))
    if not options.no_compile:
        for row in rows:
            row["compiled"] = compiled(row["task"], options.worlds)
            row |= watch.check(f"while {row['task']} was compiled")
            file.write_text(table(rows))
            file.with_suffix(".json").write_text(json.dumps(rows, indent=1))
    print(table(rows))


if __name__ == "__main__":
    main()
