"""Help for a line of a job's YAML, and the place of an error in it."""

from __future__ import annotations

import pytest

from orchestrator.console.submit_help import Problem, help_at, problem_of

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


HELP = {1: ("", "name"), 2: ("nodes", "max"), 3: ("train", "worlds"), 4: ("train", "iterations"), 0: ("", "queue")}
HELP |= {6: ("train.config", "track"), 7: ("train.config", "lidar"), 9: ("train.config.reward_function", "text")}
HELP |= {12: ("train.config.reward_function", "file"), 14: ("train.ppo", "learning_rate"), 99: ("train.ppo", "gamma")}


@pytest.mark.parametrize("line", HELP)
def test_help_is_of_the_section_in_which_the_line_stands(line: int) -> None:
    found, (section, key) = help_at(JOB, line), HELP[line]
    assert found["section"] == section and key in [each["name"] for each in found["keys"]]


def test_help_says_what_a_key_is_and_which_are_given_also_in_what_is_not_yaml_yet() -> None:
    found = help_at(JOB, 5)
    about = "simulated worlds of each rank; whole number from 1"
    assert found["key"] == {"name": "train.worlds", "about": about, "given": True}
    assert [each["name"] for each in found["keys"] if each["given"]] == ["task", "worlds", "config", "ppo"]
    assert help_at("name: x\ntrain:\n  task: Ant\n  wor: [", 4)["section"] == "train"
    assert help_at("name: [", 1)["section"] == "" == help_at("", 1)["section"]


def test_an_error_has_its_key_its_line_and_that_of_its_code() -> None:
    code = "reward_function.py:2: FORBIDDEN: open can't be used"
    found = problem_of(f"job.yaml:8: train.config.reward_function: {code}", JOB)
    assert found == Problem(code, "train.config.reward_function", 12, 2)
    inline = JOB.replace("text: |", 'text: "')
    assert problem_of(f"job.yaml:8: train.config.reward_function: {code}", inline).line == 8
    assert problem_of("job.yaml:3: not valid YAML: what", JOB) == Problem("not valid YAML: what", "", 3)
    assert problem_of("job.yaml: expected a mapping", "") == Problem("expected a mapping")
    assert problem_of("something: else", "") == Problem("something: else")
