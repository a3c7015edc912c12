"""The racer's commands, and reward functions that can't be: refused before anything is asked of a controller."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.conftest import call_muster

BODIES = {
    "return params['sped']": ":2: TEST_FAILURE: the sample 'start': KeyError: 'sped', on track oval with 133 waypoints",
    "raise SystemExit(0)": ":2: TEST_FAILURE: the sample 'start': it ended the program (SystemExit), on track oval with 133 waypoints",
}


@pytest.mark.parametrize("body", BODIES)
def test_a_bad_reward_function_is_refused_in_one_line(body: str, tmp_path: Path) -> None:
    file = tmp_path / "reward.py"
    file.write_text(f"def reward_function(params):\n    {body}\n")
    change = f"train.config.reward_function={file}"
    done = call_muster("submit", "job_specs/racer.yaml", "--set", change, home=tmp_path / "home")
    assert done.returncode == 2 and not done.stdout
    assert done.stderr == f"muster: --set: train.config.reward_function: {file}{BODIES[body]}\n"
    assert not (tmp_path / "home").exists(), "no controller was asked"
