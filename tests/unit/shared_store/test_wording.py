"""What is wrong with a setting of an algorithm, in the same words at the submission and from a rank."""

from __future__ import annotations

import math
from typing import Any

import pytest

from orchestrator.domain.errors import SpecError
from orchestrator.spec.model import validate
from worker.errors import UserError
from worker.learning.algorithms import find_algorithm, settings
from worker.tasks.configs.cartpole import CartpoleConfig


@pytest.mark.parametrize(
    ("algorithm", "key", "value", "said"),
    [
        ("ppo", "hidden_sizes", [], "hidden_sizes: expected at least one number, found []"),
        ("ppo", "epochs", 2.5, "epochs: expected a whole number, found a number (2.5)"),
        ("ppo", "schedule", "linear", "schedule: expected 'adaptive' or 'fixed', found 'linear'"),
        ("sac", "gamma", 2.0, "gamma: expected a value less than or equal to 1, found 2.0"),
        ("rsl_rl", "actor", [64], "actor: expected a mapping, found a list"),
        ("rsl_rl", "actor", {"init": math.inf}, "actor.init: expected a finite number, found a number (inf)"),
        ("rsl_rl", "algorithm", {"max_grad_norm": None}, "algorithm.max_grad_norm: expected a number, found nothing"),
        (
            *("rsl_rl", "algorithm", {"num_mini_batches": 2.5}),
            "algorithm.num_mini_batches: expected a whole number, found a number (2.5)",
        ),
    ],
)
def test_submission_and_rank_refuse_a_setting_in_the_same_words(
    algorithm: str, key: str, value: Any, said: str
) -> None:
    section = {"task": "Cartpole", "worlds": 8, "iterations": 1, "algorithm": algorithm, algorithm: {key: value}}
    with pytest.raises(SpecError) as submission:
        validate({"name": "job", "train": section}, "job.yaml")
    with pytest.raises(UserError) as rank:
        settings(find_algorithm(algorithm), algorithm, CartpoleConfig(), section)
    assert str(rank.value) == f"train.{algorithm}.{said}"
    assert str(submission.value) == f"job.yaml: {rank.value}"
