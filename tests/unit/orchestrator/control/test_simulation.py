"""The control plane in simulated worlds: nothing is lost, ended without a cause, or written twice, whatever fails when."""

from __future__ import annotations

import ast
import time

import pytest

from tests.conftest import REPOSITORY
from tests.support.simulation.mutants import MUTANTS
from tests.support.simulation.shrink import command, shrink, violation

SECONDS = 20.0
"""Of a processor, for as many seeds as can be simulated meanwhile."""
FOUND_AT = {
    "B1": (0, "is ended without a cause: lost"),
    "B2": (0, "is ended without a cause: lost"),
    "B3": (1, "the loop waits for a call"),
    "B4": (21, "the loop waits for a call"),
    "B9": (0, "is to be launched, although it is preempted"),
    "fault": (0, "is launched after ValueError in train.py, line 3 ended attempts"),
    "look": (0, "runs, and its job is STARTING"),
    "missing": (0, "and its controller has not met"),
    "stop": (18, "and its engine is away"),
    "T1": (2, "the store does not have its run"),
    "T2": (12, "is FAILED (main node: exit 0, outcome not written"),
}
"""The first seed that finds each mutant, and how: ``python -m tests.support.simulation 0 200 --mutant B1``."""


def test_all_invariants_hold_in_every_seed() -> None:
    began, seed = time.process_time(), 0
    while time.process_time() - began < SECONDS:
        if (found := violation(seed)) is not None:
            jobs, faults = shrink(seed)
            pytest.fail(
                f"{found}\n\nwith the fewest jobs and faults:\n{violation(seed, jobs, faults)}\n{command(seed, jobs, faults)}"
            )
        seed += 1


@pytest.mark.parametrize("mutant", MUTANTS)
def test_a_fault_that_is_put_back_is_found(mutant: str) -> None:
    seed, how = FOUND_AT[mutant]
    with MUTANTS[mutant]():
        assert how in (violation(seed) or "")


def test_a_seed_always_tells_the_same_story_and_is_made_smaller() -> None:
    with MUTANTS["B4"]():
        seed, _ = FOUND_AT["B4"]
        assert violation(seed) == violation(seed)
        jobs, faults = shrink(seed, range(6), range(4))
        assert violation(seed, jobs, faults) is not None and len(jobs) <= 3 and len(faults) <= 2
    assert command(seed, [3], [1, 2]) == f"python -m tests.support.simulation {seed} --jobs=3 --faults=1,2"


SOURCES = {
    *(
        "time.time",
        "time.time_ns",
        "time.monotonic",
        "time.perf_counter",
        "time.sleep",
        "datetime.now",
        "datetime.utcnow",
    ),
    *("threading.Thread", "threading.Timer", "Thread", "Timer", "ThreadPoolExecutor", "futures.ThreadPoolExecutor"),
}
ROOMS = (
    "control",
    "domain",
    "scheduling",
    "persistence",
    "engines/runner.py",
    "engines/registry.py",
    "engines/toolkit",
)


def test_time_and_threads_of_the_control_plane_come_from_its_machine() -> None:
    found = {}
    for place in (REPOSITORY / "orchestrator" / room for room in ROOMS):
        for file in [place] if place.suffix else sorted(place.rglob("*.py")):
            calls = (node.func for node in ast.walk(ast.parse(file.read_text())) if isinstance(node, ast.Call))
            if used := {ast.unparse(call) for call in calls} & SOURCES:
                found[str(file.relative_to(REPOSITORY))] = used
    assert not found
