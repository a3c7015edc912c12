"""The smallest history of a seed that still breaks something."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from tests.support.simulation.machine import Violation
from tests.support.simulation.run import FAULTS, JOBS, simulate


def violation(seed: int, jobs: Sequence[int] = JOBS, faults: Sequence[int] = FAULTS) -> str | None:
    """What a history breaks, with its story; None where all holds."""
    try:
        simulate(seed, jobs, faults)
    except Violation as found:
        return str(found)
    return None


def shrink(
    seed: int, jobs: Sequence[int] = JOBS, faults: Sequence[int] = FAULTS
) -> tuple[Sequence[int], Sequence[int]]:
    """The jobs and faults that are left once none can be taken away without the violation's going away too."""
    faults = _smallest(faults, lambda some: violation(seed, jobs, some) is not None)
    jobs = _smallest(jobs, lambda some: violation(seed, some, faults) is not None)
    return jobs, faults


def command(seed: int, jobs: Sequence[int] = JOBS, faults: Sequence[int] = FAULTS) -> str:
    """How to see it again."""
    named = {"jobs": (jobs, JOBS), "faults": (faults, FAULTS)}
    parts = [
        f"--{name}={','.join(map(str, some))}" for name, (some, every) in named.items() if list(some) != list(every)
    ]
    return " ".join(["python -m tests.support.simulation", str(seed), *parts])


def _smallest(items: Sequence[int], fails: Callable[[Sequence[int]], bool]) -> Sequence[int]:
    """Leave out halves, quarters, … and at last single items, as long as it still fails."""
    size = len(items) // 2
    while size:
        start = 0
        while start < len(items):
            fewer = [*items[:start], *items[start + size :]]
            if fails(fewer):
                items = fewer
            else:
                start += size
        size //= 2
    return items
