"""The README's commands, as they stand."""

from __future__ import annotations

from pathlib import Path

from tests.support.pages import run_page

BETWEEN_THE_LINES = """
muster serve --port 0 >again.log 2>&1 &
timeout 60 sh -c 'until muster list 2>/dev/null; do sleep 1; done'
muster submit job_specs/cartpole.yaml --set name=stopped --set train.iterations=5000
muster logs stopped -f | grep -m1 checkpoint
muster stop stopped
run=$(muster show stopped --json | python -c 'import json, sys; print(json.load(sys.stdin)["run"])')
muster resume $run --nodes 2
muster logs stopped -f | grep -m1 "on 2 ranks"
muster stop stopped
kill $!
make race
"""
"""What the README shows in its sentences."""


def test_the_readme_s_commands_train_kill_a_rank_see_it_resume_and_race(tmp_path: Path) -> None:
    printed = run_page("README.md", tmp_path, BETWEEN_THE_LINES)
    assert "SUCCEEDED  cartpole" in printed and "resumed from checkpoint" in printed
    assert "was killed by SIGKILL" in printed and "succeeded" in printed
    assert "on 2 ranks" in printed and (tmp_path / "muster" / "race.gif").stat().st_size > 10_000
