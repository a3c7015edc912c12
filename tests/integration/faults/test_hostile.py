"""A round of hostile jobs with a fixed seed; many rounds are ``make torture``."""

from __future__ import annotations

from pathlib import Path

from tests.support.faults.hostile import hostile_round


def test_hostile_jobs_leave_nothing_have_the_right_reason_and_disturb_nobody(tmp_path: Path) -> None:
    counts, violations = hostile_round(tmp_path / "home", 11, slow=False)
    assert not violations
    assert counts.total() >= 10
