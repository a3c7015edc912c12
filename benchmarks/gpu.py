"""Training on one GPU: simulation, simulation with the policy, training, and rsl-rl's own loop on the same task in the same run.

    python -m benchmarks.gpu [--tasks Ant Humanoid] [--worlds 4096 16384] [--out DIRECTORY]

Needs a CUDA device. Writes ``gpu.md`` and ``gpu.json``. Every rate is in policy steps of all worlds together per second, the median
of three stretches after everything was captured; the cold start stands apart.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from benchmarks.stock import stock_runner, stock_seconds
from shared_store.epoch import raise_epoch
from shared_store.layout import Store
from worker.distributed import Placement, connect
from worker.learning.job import Job, StopRequest
from worker.learning.recording import Recorded
from worker.learning.runner import Runner
from worker.tasks import find_task

STRETCHES, SECONDS = 3, 1.5


def build(task: str, worlds: int, store: Path, seed: int = 0) -> Runner:
    """A runner of the real training loop, on a store of its own, that never saves."""
    placement = Placement.from_env(os.environ)
    run = Store(store).open().run(f"bench-{task}-{worlds}".lower())
    if placement.rank == 0:
        run.create({"run": run.name})
        raise_epoch(run, 1)
    section = {"task": task, "worlds": worlds, "iterations": 10**9, "seed": seed}
    spec = {"train": section, "checkpoint": {"every": 10**9}}
    job = Job(spec, Store(store), run, 1, 1, "bench", None, section)
    return Runner(job, connect(placement), find_task(task), StopRequest())


def rate(step: Callable[[], Any], steps: int) -> float:
    """Policy steps a second of a function that makes ``steps`` of them."""
    for _ in range(4):
        step()
    torch.cuda.synchronize()
    started = time.perf_counter()
    step()
    torch.cuda.synchronize()
    count = max(2, round(SECONDS / (time.perf_counter() - started)))
    found = []
    for _ in range(STRETCHES):
        started = time.perf_counter()
        for _ in range(count):
            step()
        torch.cuda.synchronize()
        found.append(steps * count / (time.perf_counter() - started))
    return statistics.median(found)


def kernels(step: Callable[[], Any]) -> dict[str, Any]:
    """Where one iteration's time on the device goes: total, by kind, and the longest kernels [ms]."""
    step()
    torch.cuda.synchronize()
    with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CUDA]) as profile:
        started = time.perf_counter()
        step()
        torch.cuda.synchronize()
        wall = time.perf_counter() - started
    times: Counter[str] = Counter()
    counts: Counter[str] = Counter()
    for event in profile.events():
        times[event.name] += event.device_time_total / 1000
        counts[event.name] += 1
    kinds: Counter[str] = Counter()
    for name, spent in times.items():
        kinds[_kind(name)] += spent
    longest = {name[:110]: [round(spent, 3), counts[name]] for name, spent in times.most_common(40)}
    return {"wall_ms": 1000 * wall, "kernel_ms": sum(times.values()), "kinds": dict(kinds), "longest": longest}


def _kind(name: str) -> str:
    if any(part in name for part in ("gemm", "cutlass", "nvjet", "sm90_xmma")):
        return "matrix products"
    if any(part in name for part in ("at::native", "at::cuda", "cub::", "at_cuda")):
        return "other torch kernels"
    return "memory" if "Mem" in name else "simulation"


def measure(task: str, worlds: int, store: Path, *, stock: bool, profile: bool) -> dict[str, Any]:
    """All rows of one task and number of worlds."""
    started = time.perf_counter()
    runner = build(task, worlds, store)
    built = time.perf_counter() - started
    own, ppo = runner.task, runner.ppo
    steps = worlds * runner.config.ppo.steps
    for _ in range(3):
        runner._iterate()
    torch.cuda.synchronize()
    captured = time.perf_counter() - started
    found: dict[str, Any] = {"task": task, "worlds": worlds, "built_s": built, "captured_s": captured}
    found["train"] = rate(runner._iterate, steps)
    record = runner._iterate()[0]
    found |= {
        key: record[key] for key in ("collect_seconds", "learn_seconds", "reward", "solver_overflows", "nan_worlds")
    }
    if profile:
        found["profile"] = kernels(runner._iterate)

    def act() -> None:
        ppo.storage.clear()
        runner._collecting()

    found["policy"] = rate(act, steps)
    actions = torch.rand_like(own.actions) * 2 - 1

    def simulate() -> None:
        for _ in range(runner.config.ppo.steps):
            own.step(actions)

    simulation = Recorded(simulate, own.device, "simulation")
    found["simulation"] = rate(simulation, steps)
    found["memory_gb"] = torch.cuda.max_memory_reserved() / 1e9
    if stock:
        found["stock"] = steps / stock_seconds(stock_runner(own, runner.config.ppo), max(3, round(3e6 / steps)))
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="+", default=["Ant", "Humanoid"])
    parser.add_argument("--worlds", nargs="+", type=int, default=[4096, 16384])
    parser.add_argument("--out", type=Path, default=Path(__file__).parent)
    parser.add_argument("--no-stock", action="store_true")
    parser.add_argument("--profile", action="store_true")
    options = parser.parse_args()
    rows = []
    with tempfile.TemporaryDirectory() as store:
        for task in options.tasks:
            for worlds in options.worlds:
                row = measure(task, worlds, Path(store), stock=not options.no_stock, profile=options.profile)
                rows.append(row)
                print({key: value for key, value in row.items() if key != "profile"}, flush=True)
                (options.out / "gpu.json").write_text(json.dumps(rows, indent=1))
                torch.cuda.empty_cache()
    (options.out / "gpu.md").write_text(table(rows))


def table(rows: list[dict[str, Any]]) -> str:
    """Markdown."""
    lines = [
        f"# Training on one {torch.cuda.get_device_name()}",
        "",
        "Policy steps of all worlds together per second, in millions; `python -m benchmarks.gpu`.",
        "",
        "| task | worlds | simulation | + policy | training | stock rsl-rl | ratio | collect | learn | until captured |",
        "|---|--:|--:|--:|--:|--:|--:|--:|--:|--:|",
    ]
    for row in rows:
        stock = row.get("stock")
        ratio = f"{row['train'] / stock:.1f} ×" if stock else "–"
        lines.append(
            f"| {row['task']} | {row['worlds']:,} | {row['simulation'] / 1e6:.2f} | {row['policy'] / 1e6:.2f} | "
            f"**{row['train'] / 1e6:.2f}** | {f'{stock / 1e6:.2f}' if stock else '–'} | "
            f"{ratio} | {1000 * row['collect_seconds']:.0f} ms | "
            f"{1000 * row['learn_seconds']:.0f} ms | {row['captured_s']:.0f} s |"
        )
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
