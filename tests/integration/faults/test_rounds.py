"""A round of hostile jobs, and one with a wall clock that jumps; many of both are ``make torture``."""

from __future__ import annotations

from pathlib import Path

from tests.support.faults.hostile import hostile_round
from tests.support.faults.wall_clock import wall_clock_round


def test_hostile_jobs_leave_nothing_have_the_right_reason_and_disturb_nobody(tmp_path: Path) -> None:
    counts, violations = hostile_round(tmp_path / "home", 11, slow=False)
    assert not violations
    assert counts.total() >= 10


def test_a_wall_clock_that_jumps_ends_nothing_and_keeps_the_log_in_order(tmp_path: Path) -> None:
    done, violations = wall_clock_round(tmp_path, 5)
    assert not violations
    assert done["jumps"] == 3 and done["jobs"] == 1
