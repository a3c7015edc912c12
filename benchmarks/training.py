"""Training on this device: simulation, simulation with the policy, training, and rsl-rl's own loop on the same task in the same run.

    python -m benchmarks.training [--tasks Ant Humanoid] [--worlds 4096 16384] [--sweep Ant] [--out DIRECTORY]

On a CUDA device it writes ``gpu.md`` and ``gpu.json``, else, with fewer worlds, ``cpu.md`` and ``cpu.json``. Every rate is in policy
steps per second over all worlds, the median of three stretches after all captures; the cold start is reported separately. A loaded
machine is refused: :mod:`benchmarks.load`. Without a GPU use ``make bench``: it makes this table and that of whole trainings in one run,
and refuses tables that contradict each other.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import torch

from benchmarks.load import Watch, add_option, reported
from benchmarks.stock import stock_runner, stock_seconds
from shared_store.volume.epoch import raise_epoch
from shared_store.volume.layout import Store
from worker.learning.cuda_graph import CudaGraphFunction
from worker.learning.distributed import RankPlacement, connect
from worker.learning.job import Job, StopRequest
from worker.learning.loop import Loop
from worker.learning.setup import build_task
from worker.learning.training import Training
from worker.tasks import find_task

CUDA = torch.cuda.is_available()
STRETCHES, SECONDS = 3, 0.6
DEFAULT = {"Cartpole": [4096, 16384], "Ant": [4096, 16384], "Humanoid": [4096, 16384], "Quadruped": [4096]} | {
    "CartpolePixels": [1024, 4096]
}
"""Numbers of worlds on a GPU."""
DEFAULT_CPU = {"Cartpole": [64, 1024], "Ant": [64], "Humanoid": [32], "Quadruped": [32], "CartpolePixels": [32]}
SWEEP = [2048, 8192, 32768, 65536]


def build(
    task: str,
    worlds: int,
    store: Path,
    seed: int = 0,
    every: int = 10**9,
    loop_type: type[Loop] = Loop,
    **train: Any,
) -> Loop:
    """The real training loop, on its own store; it saves at the given interval of iterations, by default never."""
    placement = RankPlacement.from_env(os.environ)
    name = task.rpartition(":")[2]  # a task given by its path
    run = Store(store).open().run(f"bench-{name}-{worlds}-{seed}".lower())
    section = {"task": task, "worlds": worlds, "iterations": 10**9, "seed": seed, **train}
    spec = {"train": section, "checkpoint": {"every": every}}
    if placement.rank == 0:
        run.create({"run": run.name, "spec": spec})
        raise_epoch(run, 1)
    job = Job(spec, Store(store), run, 1, 1, "bench", section=section)
    return loop_type(Training.of(job, find_task(task)), connect(placement), StopRequest())


def device_name() -> str:
    """Name of the device in the tables."""
    return torch.cuda.get_device_name() if CUDA else "the CPU"


def wait() -> None:
    """Wait for the device."""
    if CUDA:
        torch.cuda.synchronize()


def rate(step: Callable[[], Any], steps: int) -> float:
    """Policy steps per second of a function that makes ``steps`` of them."""
    for _ in range(4 if CUDA else 1):
        step()
    wait()
    started = time.perf_counter()
    step()
    wait()
    count = max(2, round(SECONDS / (time.perf_counter() - started)))
    found = []
    for _ in range(STRETCHES):
        started = time.perf_counter()
        for _ in range(count):
            step()
        wait()
        found.append(steps * count / (time.perf_counter() - started))
    return statistics.median(found)


def kernels(step: Callable[[], Any]) -> dict[str, float]:
    """Time of one iteration on the device by kind of kernel [ms], and the remaining wall time without a kernel."""
    step()
    wait()
    with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CUDA]) as profile:
        started = time.perf_counter()
        step()
        wait()
        wall = 1000 * (time.perf_counter() - started)
    kinds: Counter[str] = Counter()
    for event in profile.events():
        kinds[_kind(event.name)] += event.device_time_total / 1000
    return {**kinds, "no kernel": wall - kinds.total(), "iteration": wall}


def _kind(name: str) -> str:
    if any(part in name for part in ("gemm", "cutlass", "nvjet", "xmma", "conv", "cudnn")):
        return "products and convolutions"
    if any(part in name for part in ("at::native", "at::cuda", "cub::", "at_cuda")):
        return "other torch kernels"
    if "render_megakernel" in name:
        return "camera"
    return "memory" if "Mem" in name else "simulation"


def measure(task: str, worlds: int, store: Path, *, stock: bool, profile: bool) -> dict[str, Any]:
    """All rows of one task and number of worlds."""
    started = time.perf_counter()
    runner = build(task, worlds, store)
    built = time.perf_counter() - started
    own, algorithm = runner.task, runner.algorithm
    steps = worlds * runner.config.ppo.steps
    for _ in range(3):
        runner._iterate()
    wait()
    captured = time.perf_counter() - started
    found: dict[str, Any] = {"task": task, "worlds": worlds, "built_s": built, "captured_s": captured}
    found["train"] = rate(runner._iterate, steps)
    record = runner._iterate()[0]
    found |= {key: record[key] for key in ("collect_seconds", "learn_seconds", "solver_overflows", "nan_worlds")}
    if profile and CUDA:
        found["profile"] = kernels(runner._iterate)

    def act() -> None:
        algorithm.begin(0)
        runner._collecting()

    found["policy"] = rate(act, steps)
    actions = torch.rand_like(own.actions) * 2 - 1

    def simulate() -> None:
        for _ in range(runner.config.ppo.steps):
            own.step(actions)

    found["simulation"] = rate(CudaGraphFunction(simulate, own.device, "simulation"), steps)
    if stock:
        fresh = build_task(type(own), runner.config, runner.share, runner.gang, 1)
        iterations = max(3, round((3e6 if CUDA else 3e3) / steps))
        found["stock"] = steps / stock_seconds(
            stock_runner(fresh, runner.config.ppo), iterations, warm=5 if CUDA else 1
        )
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    defaults = DEFAULT if CUDA else DEFAULT_CPU
    parser.add_argument("--tasks", nargs="+", default=list(defaults))
    parser.add_argument("--worlds", nargs="+", type=int, help="instead of each task's usual numbers")
    parser.add_argument("--sweep", nargs="*", default=[], help=f"tasks to measure with {SWEEP} worlds, too")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent)
    parser.add_argument("--no-stock", action="store_true")
    add_option(parser)
    options = parser.parse_args()
    plan = [
        (task, worlds, not options.no_stock) for task in options.tasks for worlds in options.worlds or defaults[task]
    ]
    plan += [(task, worlds, False) for task in options.sweep for worlds in SWEEP]
    for rows in measure_all(plan, Watch(options.loaded_anyway)):
        write(rows, options.out)


def measure_all(plan: list[tuple[str, int, bool]], watch: Watch) -> Iterator[list[dict[str, Any]]]:
    """The rows so far, after each task, number of worlds and whether to train with stock rsl-rl of ``plan``."""
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as store:
        for task, worlds, stock in plan:
            row = measure(task, worlds, Path(store), stock=stock, profile=worlds in (4096, 1024))
            rows.append(row | watch.check(f"while {task} with {worlds} worlds was measured"))
            print(rows[-1], flush=True)
            yield rows
            if CUDA:
                torch.cuda.empty_cache()


def write(rows: list[dict[str, Any]], directory: Path) -> None:
    """The table, and its numbers, into ``directory``."""
    name = "gpu" if CUDA else "cpu"
    (directory / f"{name}.json").write_text(json.dumps(rows, indent=1))
    (directory / f"{name}.md").write_text(table(rows))


def table(rows: list[dict[str, Any]]) -> str:
    """Markdown."""
    where = torch.cuda.get_device_name() if CUDA else f"{os.cpu_count()} cores ({platform.machine()}), no GPU"
    unit, name = (1e6, "millions") if CUDA else (1e3, "thousands")
    lines = [
        f"# Training on {where}",
        "",
        f"Policy steps of all worlds together per second, in {name}; `python -m benchmarks.training`. Stock rsl-rl trains on the same "
        f"simulation, captured, in the same run. {reported(rows)}",
        "",
        "| task | worlds | environment | + policy | training | stock rsl-rl | ratio | collect | learn | until captured |",
        "|---|--:|--:|--:|--:|--:|--:|--:|--:|--:|",
    ]
    for row in sorted(rows, key=lambda row: (row["task"], row["worlds"])):
        stock = row.get("stock")
        ratio = f"{row['train'] / stock:.1f} ×" if stock else "–"
        lines.append(
            f"| {row['task']} | {row['worlds']:,} | {row['simulation'] / unit:.2f} | {row['policy'] / unit:.2f} | "
            f"**{row['train'] / unit:.2f}** | {f'{stock / unit:.2f}' if stock else '–'} | "
            f"{ratio} | {1000 * row['collect_seconds']:.0f} ms | "
            f"{1000 * row['learn_seconds']:.0f} ms | {row['captured_s']:.0f} s |"
        )
    profiles = [row for row in rows if "profile" in row]
    kinds = sorted({kind for row in profiles for kind in row["profile"]} - {"iteration", "no kernel"})
    if profiles:
        lines += ["", "## Where an iteration goes [ms]", ""]
        lines += [
            f"| task | worlds | iteration | {' | '.join(kinds)} | no kernel |",
            "|---|" + "--:|" * (len(kinds) + 3),
        ]
    for row in profiles:
        times = [f"{row['profile'].get(kind, 0.0):.1f}" for kind in ("iteration", *kinds, "no kernel")]
        lines.append(f"| {row['task']} | {row['worlds']:,} | {' | '.join(times)} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
