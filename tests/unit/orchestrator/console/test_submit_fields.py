"""The wizard's fields, and the YAML that they are."""

from __future__ import annotations

from dataclasses import replace

import pytest

from orchestrator.console.forms import Form
from orchestrator.console.submit_fields import Group, document, filled, groups, tasks, written
from orchestrator.spec import strict_yaml
from orchestrator.spec.file import from_text


def test_the_wizard_of_every_task_begins_with_a_job_that_can_be_submitted() -> None:
    for task in tasks():
        spec = from_text(written(document(task, groups(task, ["default"]))), "job", whole=False)
        assert spec.train is not None and spec.train.task == task
        assert not any(each.startswith(":") or "`" in each for each in tasks()[task].split())
        names = [each.name for group in groups(task, ["default"]) for each in group.fields]
        assert len(names) == len(set(names)), "no two fields have one name"


CODES = ("def f():\n    return 1\n", "# ½ 😀\n\n\n\tx = 'a: b'\n", "  indented\nless\n", "trailing \n\n", "one line")


@pytest.mark.parametrize("code", [*CODES, "#:\n- &a *b\n"])
def test_code_comes_out_of_the_yaml_as_it_was_written(code: str) -> None:
    name = "train.config.reward_function"
    form = Form({name: [code.replace("\n", "\r\n")], "train.config.track": ["a", "b"], "name": ["x"]})
    job, _ = strict_yaml.load(written(document("Racer", filled(form, groups("Racer", [])))))
    assert job["train"]["config"]["reward_function"]["text"].rstrip("\n") == code.rstrip("\n")
    assert job["train"]["config"]["track"] == ["a", "b"]


def test_settings_of_an_algorithm_that_is_not_chosen_are_left_out() -> None:
    def given(group: Group) -> Group:
        values = {"train.algorithm": "sac", "train.ppo.gamma": "0.9", "train.sac.gamma": "0.8"}
        return replace(group, fields=tuple(replace(each, value=values.get(each.name, "")) for each in group.fields))

    train = document("Ant", [given(each) for each in groups("Ant", [])])["train"]
    assert train == {"task": "Ant", "algorithm": "sac", "sac": {"gamma": 0.8}}


VALUES = {"3": 3, "3e-4": 0.0003, "-1E5": -1e5, "[1, 2.5]": [1, 2.5], "{a: 1}": {"a": 1}, "x": "x", "[1": "[1"}
VALUES["&a 1"] = "&a 1"


@pytest.mark.parametrize("text", VALUES)
def test_a_value_is_read_as_yaml_and_stays_a_text_where_it_is_none(text: str) -> None:
    form = Form({"train.config.episode_seconds": [text]})
    found = document("Ant", filled(form, groups("Ant", [])))["train"]["config"]["episode_seconds"]
    assert found == VALUES[text]
