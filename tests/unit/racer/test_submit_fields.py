"""The fields of the racer's wizard: code, and the place of an error in it."""

from __future__ import annotations

import pytest

from orchestrator.console.forms import Form
from orchestrator.console.submit_fields import document, filled, groups, written
from orchestrator.console.submit_help import SubmissionProblem, help_at, problem_of
from orchestrator.spec import strict_yaml

CODES = ("def f():\n    return 1\n", "# ½ 😀\n\n\n\tx = 'a: b'\n", "  indented\nless\n", "trailing \n\n", "one line")


@pytest.mark.parametrize("code", [*CODES, "#:\n- &a *b\n"])
def test_code_comes_out_of_the_yaml_as_it_was_written(code: str) -> None:
    name = "train.config.reward_function"
    form = Form({name: [code.replace("\n", "\r\n")], "train.config.track": ["a", "b"], "name": ["x"]})
    job, _ = strict_yaml.load(written(document("Racer", filled(form, groups("Racer", [])))))
    assert job["train"]["config"]["reward_function"]["text"].rstrip("\n") == code.rstrip("\n")
    assert job["train"]["config"]["track"] == ["a", "b"]


JOB = """name: x
nodes: {min: 1, max: 2}
train:
  task: Racer
  worlds: 1
  config:
    track: oval
    reward_function:
      file: a.py
      text: |
        def reward_function(params):
            return 1.0
  ppo:
    gamma: 0.9
"""


HELP = {6: ("train.config", "track"), 7: ("train.config", "lidar"), 9: ("train.config.reward_function", "text")}
HELP |= {12: ("train.config.reward_function", "file"), 14: ("train.ppo", "learning_rate")}


@pytest.mark.parametrize("line", HELP)
def test_help_is_of_the_section_in_which_the_line_stands(line: int) -> None:
    found, (section, key) = help_at(JOB, line), HELP[line]
    assert found["section"] == section and key in [each["name"] for each in found["keys"]]


def test_an_error_has_its_key_its_line_and_that_of_its_code() -> None:
    code = "reward_function.py:2: FORBIDDEN: open can't be used"
    found = problem_of(f"job.yaml:8: train.config.reward_function: {code}", JOB)
    assert found == SubmissionProblem(code, "train.config.reward_function", 12, 2)
    inline = JOB.replace("text: |", 'text: "')
    assert problem_of(f"job.yaml:8: train.config.reward_function: {code}", inline).line == 8
