"""The wizard's fields, the YAML that they are, help for a line of it, and the place of an error in it."""

from __future__ import annotations

from dataclasses import replace

import pytest

from orchestrator.console.forms import Form
from orchestrator.console.submit_fields import FieldGroup, document, filled, groups, tasks, written
from orchestrator.console.submit_help import SubmissionProblem, help_at, problem_of
from orchestrator.spec.file import from_text


def test_the_wizard_of_every_task_begins_with_a_job_that_can_be_submitted() -> None:
    for task in tasks():
        spec = from_text(written(document(task, groups(task, ["default"]))), "job", whole=False)
        assert spec.train is not None and spec.train.task == task
        assert not any(each.startswith(":") or "`" in each for each in tasks()[task].split())
        names = [each.name for group in groups(task, ["default"]) for each in group.fields]
        assert len(names) == len(set(names)), "no two fields have one name"


def test_settings_of_an_algorithm_that_is_not_chosen_are_left_out() -> None:
    def supplied(group: FieldGroup) -> FieldGroup:
        values = {"train.algorithm": "sac", "train.ppo.gamma": "0.9", "train.sac.gamma": "0.8"}
        return replace(group, fields=tuple(replace(each, value=values.get(each.name, "")) for each in group.fields))

    train = document("Ant", [supplied(each) for each in groups("Ant", [])])["train"]
    assert train == {"task": "Ant", "algorithm": "sac", "sac": {"gamma": 0.8}}


VALUES = {"3": 3, "3e-4": 0.0003, "-1E5": -1e5, "[1, 2.5]": [1, 2.5], "{a: 1}": {"a": 1}, "x": "x", "[1": "[1"}
VALUES["&a 1"] = "&a 1"


@pytest.mark.parametrize("text", VALUES)
def test_a_value_is_read_as_yaml_and_stays_a_text_where_it_is_none(text: str) -> None:
    form = Form({"train.config.episode_seconds": [text]})
    found = document("Ant", filled(form, groups("Ant", [])))["train"]["config"]["episode_seconds"]
    assert found == VALUES[text]


JOB = """name: x
nodes: {min: 1, max: 2}
train:
  task: CartpolePixels
  worlds: 1
  config:
    cart_limit: 2.0
    camera:
      width: 32
  ppo:
    gamma: 0.9
"""


HELP = {1: ("", "name"), 2: ("nodes", "max"), 3: ("train", "worlds"), 4: ("train", "iterations"), 0: ("", "queue")}
HELP |= {6: ("train.config", "cart_limit"), 7: ("train.config", "camera"), 9: ("train.config.camera", "height")}
HELP |= {11: ("train.ppo", "learning_rate"), 99: ("train.ppo", "gamma")}


@pytest.mark.parametrize("line", HELP)
def test_help_is_of_the_section_in_which_the_line_stands(line: int) -> None:
    found, (section, key) = help_at(JOB, line), HELP[line]
    assert found["section"] == section and key in [each["name"] for each in found["keys"]]


def test_help_says_what_a_key_is_and_which_are_given_also_in_what_is_not_yaml_yet() -> None:
    found = help_at(JOB, 5)
    about = "simulated worlds of each rank; integer from 1"
    assert found["key"] == {"name": "train.worlds", "about": about, "present": True}
    assert [each["name"] for each in found["keys"] if each["present"]] == ["task", "worlds", "config", "ppo"]
    assert help_at("name: x\ntrain:\n  task: Ant\n  wor: [", 4)["section"] == "train"
    assert help_at("name: [", 1)["section"] == "" == help_at("", 1)["section"]


def test_an_error_has_its_key_and_its_line() -> None:
    found = problem_of("job.yaml:9: train.config.camera.width: expected", JOB)
    assert found == SubmissionProblem("expected", "train.config.camera.width", 9)
    assert problem_of("job.yaml:3: not valid YAML: what", JOB) == SubmissionProblem("not valid YAML: what", "", 3)
    assert problem_of("job.yaml: expected an object", "") == SubmissionProblem("expected an object")
    assert problem_of("something: else", "") == SubmissionProblem("something: else")
