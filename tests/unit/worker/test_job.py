"""What a rank says of a job whose submission was not checked, such as one of the Batch API."""

from __future__ import annotations

import json
from typing import Any

import pytest

from worker.errors import UserError
from worker.learning import algorithms
from worker.learning.algorithms import find_algorithm
from worker.learning.job import Job

ENVIRONMENT = {"MUSTER_STORE": "/store", "MUSTER_RUN": "run"}


def read(train: dict[str, Any], **spec: Any) -> Job:
    return Job.from_env({**ENVIRONMENT, "MUSTER_SPEC": json.dumps({"train": train, **spec})}, "train")


@pytest.mark.parametrize(
    ("train", "said"),
    [
        ({"ppo": 5}, "train.ppo: expected a mapping, found a whole number (5)"),
        ({"algorithm": "sac", "sac": [1]}, "train.sac: expected a mapping, found a list"),
        ({"algorithm": "my:Mine", "settings": "x"}, "train.settings: expected a mapping, found a text ('x')"),
        ({"config": True}, "train.config: expected a mapping, found true or false (True)"),
        ({"algorithm": 5}, "train.algorithm: expected a text, found a whole number (5)"),
        ({"algorithm": None}, "train.algorithm: expected a text, found nothing"),
    ],
)
def test_an_invalid_section_is_refused_in_one_line(train: dict[str, Any], said: str) -> None:
    with pytest.raises(UserError) as refused:
        read(train)
    assert str(refused.value) == said


def test_an_invalid_section_of_the_spec_is_refused_too() -> None:
    with pytest.raises(UserError, match=r"^checkpoint: expected a mapping, found a whole number \(5\)$"):
        read({"task": "Ant"}, checkpoint=5)
    assert read({"task": "Ant", "ppo": None, "config": {}}, checkpoint=None).section["task"] == "Ant"


@pytest.mark.parametrize("name", [":X", "my_module:", "", "pp", "a b:C", ".:C"])
def test_a_name_of_no_algorithm_is_refused_with_those_that_there_are(name: str) -> None:
    with pytest.raises(UserError) as refused:
        find_algorithm(name)
    assert str(refused.value) == (
        f"train.algorithm: no algorithm is called {name!r}; known: ppo, rsl_rl, sac, and module:Class of your own"
    )


def test_an_uninstalled_source_tree_has_its_own_algorithms(monkeypatch: pytest.MonkeyPatch) -> None:
    there = algorithms.installed()
    monkeypatch.setattr(algorithms, "entry_points", lambda group: ())
    assert algorithms.installed() == there and there["ppo"] == "worker.learning.ppo.fused:PPO"
