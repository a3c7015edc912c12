"""A short torture with fixed seeds; the long one is ``make torture``."""

from __future__ import annotations

from pathlib import Path

from tests.support.faults.fire import Fire, run_straight
from tests.support.faults.home import Home
from tests.support.faults.outages import OUTAGES, outage_round
from tests.support.faults.schedule import SHARES, draw_plan
from tests.support.processes import end_all

ITERATIONS = 250
PLAN = draw_plan("suite-518", 8)
"""One node: its writer is hit at leisure and inside a commit, then its rank inside a commit, then the controller: frozen, and killed
again and again while the gang starts anew."""


def test_a_run_under_fire_ends_with_the_bits_of_a_straight_one(tmp_path: Path) -> None:
    home = Home(tmp_path / "home")
    try:
        reference = run_straight(home, PLAN.nodes, ITERATIONS)
        result = Fire(home, PLAN, ITERATIONS, print).carry_out(reference)
    finally:
        home.close()
        end_all(home.path)
    assert not result.verdict.violations
    assert len(result.hits) == len(PLAN.blows) and {hit.target for hit in result.hits} < SHARES.keys()
    assert result.verdict.attempts == 2 and result.verdict.checkpoints >= 3
    assert result.controller_starts >= 3


def test_outages_of_network_and_store_and_a_moved_controller_end_nothing_and_change_no_bit(tmp_path: Path) -> None:
    done, violations = outage_round(tmp_path, 7, sizes=(2,), blows=tuple(OUTAGES), longest=12.0)
    assert not violations
    assert done == {**dict.fromkeys(OUTAGES, 1), "runs": 1}
