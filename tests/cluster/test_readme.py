"""The README's commands, as they stand."""

from __future__ import annotations

from pathlib import Path

from tests.support.pages import run_page


def test_the_readme_s_commands_train_kill_a_rank_see_it_resume_and_race(tmp_path: Path) -> None:
    """Of what it shows in its sentences, ``make race``, of a tenth of the iterations; stop and resume are in the quick start."""
    printed = run_page("README.md", tmp_path, "make race ITERATIONS=10")
    assert "SUCCEEDED  cartpole" in printed and "resumed from checkpoint" in printed
    assert "was killed by SIGKILL" in printed and "succeeded" in printed
    assert (tmp_path / "muster" / "race.gif").stat().st_size > 10_000
