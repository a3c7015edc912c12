"""Reward functions of the racer: calls per second, compiled to this device and in Python workers.

    python -m benchmarks.rewards [--cars 256 4096] [--out DIRECTORY]

The Python workers' time includes the copies from and to the device. Each car has a copy of the function; the memory is that of one process with
all cars. Writes ``rewards.md``.
"""

from __future__ import annotations

import argparse
import os
import random
import statistics
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
import warp as wp

from benchmarks.load import Watch, add_option, reported
from benchmarks.training import CUDA, device_name
from racer.rewards.parameters import row_of
from racer.rewards.reward import RewardFunction
from racer.rewards.samples import oval, oval_track, random_sample
from racer.rewards.workers import Workers

FUNCTIONS = {
    "heading and speed": """import math
def reward_function(params):
    points = params["waypoints"]
    before, after = params["closest_waypoints"]
    track = math.degrees(math.atan2(points[after][1] - points[before][1], points[after][0] - points[before][0]))
    miss = abs((track - params["heading"] + 180.0) % 360.0 - 180.0)
    return math.exp(-miss / 30.0) * params["speed"] + params["progress"] / max(params["steps"], 1)
""",
    "closest of all waypoints": """import math
def reward_function(params):
    best = 1e9
    for x, y in params["waypoints"]:
        best = min(best, math.hypot(x - params["x"], y - params["y"]))
    return 1.0 / (0.1 + best)
""",
}
ROWS = ", ".join(
    f"[{3.0 + 0.01 * row:.5f}, {0.02 * row:.5f}, {1.5 + row % 9 / 10:.5f}, {0.05 + row % 5 / 1000:.5f}]"
    for row in range(300)
)
CLASS = f"""import math
class Reward:
    def __init__(self):
        self.line = [{ROWS}]
        self.last = 0
    def away(self, x, y):
        return [math.hypot(row[0] - x, row[1] - y) for row in self.line]
    def reward(self, params):
        away = self.away(params["x"], params["y"])
        gained, self.last = away.index(min(away)) - self.last, away.index(min(away))
        return float(gained)
reward = Reward()
def reward_function(params):
    return reward.reward(params)
"""
"""A class with a racing line of 300 rows, as people paste it."""
ROUNDS, SECONDS = 5, 1.0


def filled(reward: RewardFunction, cars: int) -> None:
    """Cars anywhere on the oval."""
    chance = random.Random(1)
    numbers, objects = reward.race.numbers.numpy().copy(), reward.race.objects.numpy().copy()
    for car in range(cars):
        params = random_sample(oval_track(), chance)
        numbers[car], rows = row_of(params, track=int(params["is_reversed"]))
        objects[car, : len(rows)] = rows if rows else 0.0
    reward.race.numbers.assign(numbers)
    reward.race.objects.assign(objects)


def rate(reward: RewardFunction, cars: int) -> float:
    """Calls per second, the median of several rounds."""
    reward.rewards()
    found = []
    for _ in range(ROUNDS):
        count, started = 0, time.perf_counter()
        while time.perf_counter() - started < SECONDS / ROUNDS or not count:
            for _ in range(10 if reward.function is not None else 1):
                reward.rewards()
                count += 1
            wp.synchronize()
        found.append(cars * count / (time.perf_counter() - started))
    assert np.isfinite(reward.rewards().numpy()).all()
    return statistics.median(found)


def measure(name: str, cars: int) -> dict[str, Any]:
    """Both forms of a function."""
    row: dict[str, Any] = {"name": name, "cars": cars}
    for form, compiled in (("compiled", True), ("workers", False)):
        device = f"cuda:{torch.cuda.current_device()}" if CUDA else "cpu"
        reward = RewardFunction(FUNCTIONS[name], [oval(), oval()[::-1]], cars, device, compiled=compiled)
        assert (reward.function is not None) == compiled, reward.reason
        filled(reward, cars)
        row[form] = rate(reward, cars)
        reward.close()
    return row


def memory(cars: int) -> str:
    """A row: resident memory of a process that has a copy of the class for each car, and how long it took to make them."""
    started = time.perf_counter()
    with Workers(CLASS, "class.py", [oval()], cars, 1) as workers:
        took = time.perf_counter() - started
        status = Path(f"/proc/{workers.processes[0].pid}/status").read_text()
    used = int(status.partition("VmRSS:")[2].split()[0]) / 1024
    return f"| {cars:,} | {used:,.0f} | {took:.2f} |"


def memory_table() -> str:
    """Markdown: the memory of copies."""
    lines = [
        "## Memory",
        "",
        f"One process with a copy for each car of a class of {len(CLASS) / 1000:.0f} KB that holds a racing line of 300 rows.",
        "",
        "| cars | resident [MiB] | to start [s] |",
        "|--:|--:|--:|",
        *map(memory, (1, 256, 4096)),
    ]
    return "\n".join(lines) + "\n"


def table(rows: list[dict[str, Any]]) -> str:
    """Markdown."""
    lines = [
        f"# Reward functions on {device_name()}",
        "",
        f"`python -m benchmarks.rewards`; medians of {ROUNDS} rounds; Python workers on {len(os.sched_getaffinity(0))} processors. {reported(rows)}",
        "",
        "| function | cars | compiled [calls/s] | Python workers [calls/s] | ratio |",
        "|---|--:|--:|--:|--:|",
    ]
    for row in rows:
        ratio = row["compiled"] / row["workers"]
        lines.append(
            f"| {row['name']} | {row['cars']:,} | {row['compiled']:,.0f} | {row['workers']:,.0f} | {ratio:,.0f} |"
        )
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cars", nargs="+", type=int, default=[256, 4096])
    parser.add_argument("--out", type=Path, default=Path(__file__).parent)
    add_option(parser)
    options = parser.parse_args()
    watch, rows = Watch(options.loaded_anyway), list[dict[str, object]]()
    for name in FUNCTIONS:
        for cars in options.cars:
            rows.append(measure(name, cars) | watch.check(f"while {name} was measured"))
            (options.out / "rewards.md").write_text(table(rows))
    text = f"{table(rows)}\n{memory_table()}"
    (options.out / "rewards.md").write_text(text)
    print(text)


if __name__ == "__main__":
    main()
