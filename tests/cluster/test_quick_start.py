"""The quick start's commands, as they stand: minutes, on a machine that they have for themselves."""

from __future__ import annotations

from pathlib import Path

from tests.support.pages import run_page


def test_the_quick_start_s_commands_run_as_they_stand(tmp_path: Path) -> None:
    printed = run_page("docs/quick-start.md", tmp_path, without="make run")  # the README's test runs it
    assert "SUCCEEDED  cartpole" in printed and "sum = 6, expected 6" in printed
