"""Simulation of cars with cameras, without a policy: cars · steps a second, by the number of cars and the size of the image.

    python -m benchmarks.racer_simulation [--cars 1024 4096] [--images 160x120 64x64] [--out DIRECTORY]

Everything but cars and image is that of job_specs/racer-pixels.yaml; every step renders one image a car. Writes ``racer_simulation.md``,
on a machine without a GPU ``racer_simulation_cpu.md``.
"""

from __future__ import annotations

import argparse
import os
import tempfile
from pathlib import Path
from typing import Any

import torch
import yaml

from benchmarks.load import Watch, add_option, reported
from benchmarks.racer import HERE, JOBS, REAL_TIME, merged, simulation_rate
from benchmarks.training import CUDA, build, device_name
from worker.settings.errors import UserError

TASK = "RacerPixels"


def measure(cars: int, width: int, height: int) -> dict[str, Any]:
    """The rate of one number of cars with one size of image [cars · steps/s]."""
    section = yaml.safe_load((HERE.parent / "job_specs" / JOBS[TASK]).read_text())["train"]
    section = merged(section, {"config": {"front": {"width": width, "height": height}}})
    for name in ("task", "worlds", "seed"):
        section.pop(name)
    with tempfile.TemporaryDirectory() as store:
        loop = build(TASK, cars, Path(store), **section)
        found = simulation_rate(loop.task)
        loop.close()
    if CUDA:
        torch.cuda.empty_cache()
    return {"image": (width, height), "cars": cars, "rate": found}


def table(rows: list[dict[str, Any]]) -> str:
    """Markdown."""
    device = device_name() if CUDA else f"{os.cpu_count()} CPU cores"
    lines = [
        f"# Simulation of cars with cameras, on {device}",
        "",
        f"`python -m benchmarks.racer_simulation`: no policy, one grey image a car and step. {reported(rows)}",
        "",
        "| image [px] | cars | cars · steps/s | × one car in real time |",
        "|---|--:|--:|--:|",
    ]
    for row in rows:
        width, height = row["image"]
        rate = row["rate"]
        lines.append(f"| {width} x {height} | {row['cars']:,} | {rate:,.0f} | {rate / REAL_TIME:,.0f} |")
    lines += [
        "",
        f"DeepRacer's own simulator drives one car a process in real time, {REAL_TIME:g} control steps a second.",
    ]
    return "\n".join(lines) + "\n"


def image(text: str) -> tuple[int, int]:
    """Width and height [px] of ``160x120``. Raises ValueError, which argparse tells, for anything else."""
    width, height = map(int, text.split("x"))
    return width, height


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cars", type=int, nargs="+", default=[1024, 4096] if CUDA else [32])
    parser.add_argument("--images", type=image, nargs="+", default=[(160, 120), (64, 64)], metavar="WIDTHxHEIGHT")
    parser.add_argument("--out", type=Path, default=HERE)
    add_option(parser)
    options = parser.parse_args()
    watch = Watch(options.loaded_anyway)
    rows = []
    for width, height in options.images:
        for cars in options.cars:
            try:
                row = measure(cars, width, height)
            except UserError as error:
                parser.error(str(error))
            rows.append(row | watch.check(f"while {cars} cars drove"))
    options.out.mkdir(parents=True, exist_ok=True)
    (options.out / ("racer_simulation.md" if CUDA else "racer_simulation_cpu.md")).write_text(table(rows))
    print(table(rows), end="")


if __name__ == "__main__":
    main()
