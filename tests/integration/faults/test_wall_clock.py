"""A round with a wall clock that jumps; many are ``make torture``."""

from __future__ import annotations

from pathlib import Path

from tests.support.faults.wall_clock import wall_clock_round


def test_a_wall_clock_that_jumps_ends_nothing_and_keeps_the_log_in_order(tmp_path: Path) -> None:
    done, violations = wall_clock_round(tmp_path, 5)
    assert not violations
    assert done["jumps"] == 3 and done["jobs"] == 1
