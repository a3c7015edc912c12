"""What may become of a policy outside training: it is read back, and exported, or refused in one line."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from shared_store.layout import Run
from tests.support.worker.sac import make, point
from worker.errors import TrainingError, UserError
from worker.export import export
from worker.learning.algorithm import ExportedPolicy
from worker.learning.trained import load_policy

torch.set_num_threads(1)
FACTS = {"task": "Point", "algorithm": "mine:Mine", "policy": {"groups": {"policy": [2]}, "action_size": 2}}


class Sum(nn.Module):
    """Gives its input, or its input and a sum of all so far."""

    def __init__(self, state: bool, offset: float = 0.0) -> None:
        super().__init__()
        self.state, self.offset = state, offset

    def forward(self, obs: torch.Tensor, total: torch.Tensor | None = None) -> Any:
        if total is None:
            return obs + self.offset
        return total + obs + self.offset, total + obs


class Summing:
    """Remembers the sum of what it saw, and may keep that from its export."""

    def __init__(self, tells: bool, offset: float = 0.0) -> None:
        self.tells, self.offset, self.total = tells, offset, torch.zeros(1)

    def act(self, observations: TensorDict) -> torch.Tensor:
        self.total = self.total + observations["policy"]
        return self.total

    def reset(self, worlds: torch.Tensor | None = None) -> None:
        self.total = torch.zeros(1)

    def module(self) -> ExportedPolicy:
        sample = TensorDict({"policy": torch.randn(16, 2)}, batch_size=[16])
        state = {"total": torch.zeros(1, 2)} if self.tells else {}
        outputs = ["actions", "total_out"] if self.tells else ["actions"]
        return ExportedPolicy(Sum(self.tells, self.offset), {"obs": sample["policy"][:1], **state}, outputs, sample)


def exported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, policy: Any) -> Path:
    checkpoint: Any = SimpleNamespace(name="00000004-e1", iteration=4, manifest=FACTS)
    monkeypatch.setattr("worker.learning.trained.load_policy", lambda checkpoint: policy)
    run = Run(tmp_path)
    try:
        return export(run, checkpoint)
    except (TrainingError, UserError):
        assert not list(run.exports.glob("**/*")), "nothing is published"
        raise


def test_a_memory_that_the_export_does_not_have_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In the first step the two are alike."""
    there = (
        r"^the policy of algorithm mine:Mine remembers what it saw before, but its module\(\) has no recurrent state"
    )
    with pytest.raises(UserError, match=there):
        exported(tmp_path, monkeypatch, Summing(tells=False))


def test_a_memory_that_the_export_has_is_compared_over_several_steps(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert (exported(tmp_path, monkeypatch, Summing(tells=True)) / "policy.onnx").exists()
    with pytest.raises(TrainingError, match=r"differs from the trained one by 0\.1"):
        exported(tmp_path / "other", monkeypatch, Summing(tells=True, offset=0.1))


def test_a_policy_without_a_memory_is_exported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert (exported(tmp_path, monkeypatch, make(point()).policy()) / "policy.json").exists()


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"steps": 8, "momentum": 0.9}, r"settings\.momentum: .*, found 0\.9"),
        ({"steps": 0}, r"settings\.steps: .*, found 0"),
        ({"critic_observations": "policy", "kernel_sizes": [9]}, r"settings: channels, kernel_sizes and strides: give"),
    ],
)
def test_settings_that_the_algorithm_does_not_take_any_more_are_told_in_one_line(
    settings: dict[str, Any], said: str
) -> None:
    """As after an upgrade: a checkpoint has the settings of the program that wrote it."""
    checkpoint: Any = SimpleNamespace(name="00000004-e1", manifest={**FACTS, "algorithm": "ppo", "settings": settings})
    there = rf"^checkpoint 00000004-e1: algorithm ppo refuses what it was trained with: {said}"
    with pytest.raises(UserError, match=there) as caught:
        load_policy(checkpoint)
    assert "\n" not in str(caught.value)
