"""Reward functions that can't be: `muster submit` refuses each in one line, before anything is asked of a controller."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.conftest import call_muster

BODIES = {
    "while True: pass": ":2: TIMEOUT: the sample 'start' did not end within 5 s",
    "return None": ":1: TEST_FAILURE: the sample 'start': it returned None; return a number on every way through the function",
    "return 'far'": ":1: TEST_FAILURE: the sample 'start': it returned a str; return a number",
    "return float('nan')": ":1: TEST_FAILURE: the sample 'start': it returned nan; return a finite number",
    "return 1 / params['progress'].real if params['is_reversed'] else params['sped']": ":2: TEST_FAILURE: the sample 'start': KeyError: 'sped'",
    "params['speed'] = 9.0; return 1.0": ":1: TEST_FAILURE: the sample 'start': it changed params['speed']; copy what you change",
    "return float(len([0] * 10**10))": ":2: TEST_FAILURE: the sample 'start': it used more than 2 GiB of memory",
    "[print('far away') for _ in range(1000000)]; return 1.0": ":2: TEST_FAILURE: the sample 'start' printed more than 64 KiB of text",
    "import socket; return 1.0": ":2: IMPORT_ERROR: socket can't be imported; a reward function may import math, random, numpy, scipy, shapely",
    "return eval('1.0')": ":2: FORBIDDEN: eval can't be used in a reward function",
    "return (1.0": ":2: SYNTAX_ERROR: '(' was never closed",
    "raise SystemExit(0)": ":2: TEST_FAILURE: the sample 'start': it ended the program (SystemExit)",
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
