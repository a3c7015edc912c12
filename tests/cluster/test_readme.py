"""The README's commands, as they stand."""

from __future__ import annotations

from pathlib import Path

from tests.support.pages import run_page


def test_the_readme_s_commands_train_kill_a_rank_and_see_it_resume(tmp_path: Path) -> None:
    printed = run_page("README.md", tmp_path)
    assert "SUCCEEDED  cartpole" in printed and "resumed from checkpoint" in printed
    assert "was killed by SIGKILL" in printed and "succeeded" in printed
