"""Simulate seeds of the control plane.

Examples:
  python -m tests.support.simulation 7                      one seed; what fails is made smaller
  python -m tests.support.simulation 7 --jobs=3 --faults=2  a part of its jobs and faults
  python -m tests.support.simulation 0 20000                a range of seeds, on all cores
  python -m tests.support.simulation 0 200 --mutant B1      with a fault of the controller put back, until it is found
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from contextlib import nullcontext
from functools import partial
from multiprocessing import get_context

from tests.support.simulation.mutants import MUTANTS
from tests.support.simulation.run import FAULTS, JOBS
from tests.support.simulation.shrink import command, shrink, violation

_SEEDS = 50
"""Seeds of one process: it would grow."""


def _numbers(text: str) -> list[int]:
    return [int(each) for each in text.split(",") if each]


def _try(mutant: str | None, seed: int) -> tuple[int, str | None]:
    with MUTANTS[mutant]() if mutant else nullcontext():
        return seed, violation(seed)


def _many(first: int, last: int, mutant: str | None) -> int:
    """Seeds on all cores; returns how many failed. With a mutant: until the first that does."""
    began, failed, done = time.monotonic(), 0, 0
    with get_context("fork").Pool(os.cpu_count(), maxtasksperchild=_SEEDS) as pool:
        for seed, found in pool.imap_unordered(partial(_try, mutant), range(first, last)):
            done += 1
            if found is not None:
                failed += 1
                print(found, command(seed), sep="\n", flush=True)
                if mutant:
                    break
            if done % 100 == 0:
                print(
                    f"{done} seeds, {failed} failed, {done / (time.monotonic() - began) * 60:.0f} a minute", flush=True
                )
    print(f"{done} seeds, {failed} failed, {time.monotonic() - began:.0f} s on {os.cpu_count()} cores")
    return failed


def _one(seed: int, jobs: list[int], faults: list[int]) -> int:
    found = violation(seed, jobs, faults)
    if found is None:
        print(f"seed {seed}: all holds")
        return 0
    print(found)
    jobs, faults = map(list, shrink(seed, jobs, faults))
    print("", "with the fewest jobs and faults:", violation(seed, jobs, faults), command(seed, jobs, faults), sep="\n")
    return 1


def main() -> int:
    form = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser("python -m tests.support.simulation", description=__doc__, formatter_class=form)
    parser.add_argument("seed", type=int)
    parser.add_argument("end", type=int, nargs="?", help="the first seed that is not simulated any more")
    parser.add_argument("--jobs", type=_numbers, default=list(JOBS), help="numbers of the jobs that take part")
    parser.add_argument("--faults", type=_numbers, default=list(FAULTS), help="numbers of the faults that happen")
    parser.add_argument("--mutant", choices=MUTANTS, help="a fault of the controller to be found")
    requested = parser.parse_args()
    if requested.end is not None:
        failed = _many(requested.seed, requested.end, requested.mutant)
        return int(bool(failed) != bool(requested.mutant))
    with MUTANTS[requested.mutant]() if requested.mutant else nullcontext():
        return _one(requested.seed, requested.jobs, requested.faults)


if __name__ == "__main__":
    sys.exit(main())
