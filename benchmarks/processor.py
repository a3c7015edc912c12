"""Both tables of training without a GPU, ``cpu.md`` and ``curves_cpu.md``, in one run, so that they describe one machine in one state.

    python -m benchmarks.processor [--out DIRECTORY]

Nothing is written unless the machine was not loaded during any measurement (:mod:`benchmarks.load`) and the two tables agree where they
overlap.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from benchmarks import curves, training
from benchmarks.load import Watch, add_option

AGREEMENT = 1.5
"""Tolerated relative difference between a whole training and the rate of the same task and number of worlds."""


def contradictions(rates: list[dict[str, Any]], trainings: list[dict[str, Any]]) -> list[str]:
    """Contradictions between a table of rates and one of whole trainings, one line each."""
    found = []
    for row in trainings:
        steps, by = row["curve"][-1][1], "stock" if row.get("stock") else "train"
        for rate in rates:
            if (rate["task"], rate["worlds"]) != (row["task"], row["worlds"]) or by not in rate:
                continue
            expected = steps / rate[by]
            if not expected / AGREEMENT <= row["seconds"] <= expected * AGREEMENT:
                name = "stock rsl-rl" if row.get("stock") else "Muster"
                found.append(
                    f"{row['task']} with {row['worlds']} worlds by {name}: {steps:,} steps took {row['seconds']:.1f} s, its rate says "
                    f"{expected:.1f} s"
                )
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent)
    add_option(parser)
    options = parser.parse_args()
    if training.CUDA:
        raise SystemExit("this machine has a GPU; use make bench-gpu, or hide it: CUDA_VISIBLE_DEVICES= make bench")
    watch = Watch(options.loaded_anyway)
    plan = [(task, worlds, True) for task, numbers in training.DEFAULT_CPU.items() for worlds in numbers]
    *_, rates = training.measure_all(plan, watch)
    *_, trainings = curves.train_all(list(curves.PLAN_CPU), curves.STOCK_CPU, watch)
    if found := contradictions(rates, trainings):
        raise SystemExit("the tables contradict each other, so nothing was written:\n" + "\n".join(found))
    training.write(rates, options.out)
    curves.write(trainings, options.out)
    curves.draw(trainings, options.out)


if __name__ == "__main__":
    main()
