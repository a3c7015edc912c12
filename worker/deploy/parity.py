"""The parity of an exported policy with the trained one: on observations of real roll-outs, their extremes, and made-up ones."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from tensordict import TensorDict

from worker.settings.errors import TrainingError, UserError

if TYPE_CHECKING:
    from worker.deploy.model_file import OnnxPolicy
    from worker.learning.algorithm import ExportedPolicy, Policy

TOLERANCE = 1e-5
"""Greatest difference of an action, absolute up to 1 and relative beyond."""
STEPS = 3
"""Steps on made-up observations: a single step would not show a policy's memory."""


@dataclass(frozen=True)
class RecordedObservations:
    """The observations of some worlds, step by step."""

    inputs: Mapping[str, np.ndarray]
    """By name of the policy's input, shape (steps, worlds, …); its groups in the policy's order."""
    begins: np.ndarray
    """Whether an episode begins with this step, so that the policy remembers nothing; shape (steps, worlds), bool."""

    @property
    def count(self) -> int:
        """Observations."""
        return int(self.begins.size)

    @property
    def resets(self) -> int:
        """Episodes that begin after the first step."""
        return int(self.begins[1:].sum())


def single(inputs: Mapping[str, np.ndarray]) -> RecordedObservations:
    """Observations that have nothing to do with each other, by name of the input, shape (n, …): one step of n worlds."""
    count = len(next(iter(inputs.values())))
    return RecordedObservations({name: each[None] for name, each in inputs.items()}, np.ones((1, count), dtype=bool))


def made_up(exported: ExportedPolicy) -> RecordedObservations:
    """The policy's own sample, in another order in each step: numbers that no roll-out showed."""
    count = exported.sample.batch_size[0]
    steps = [exported.named(exported.sample[(torch.arange(count) + step) % count]) for step in range(STEPS)]
    begins = np.zeros((STEPS, count), dtype=bool)
    begins[0] = True
    return RecordedObservations({name: np.stack([step[name].numpy() for step in steps]) for name in steps[0]}, begins)


def trained_actions(policy: Policy, recording: RecordedObservations, groups: Mapping[str, str]) -> np.ndarray:
    """Actions of the trained policy, on the CPU; shape (steps, worlds, actions).

    Args:
        policy: As it was trained, not as it is exported.
        recording: What it sees.
        groups: The observation group of each input.
    """

    def act(inputs: Mapping[str, np.ndarray]) -> np.ndarray:
        seen = {groups[name]: torch.from_numpy(each.copy()) for name, each in inputs.items()}
        return policy.act(TensorDict(seen, batch_size=[recording.begins.shape[1]])).numpy().copy()

    return _actions(policy, recording, act)


def _actions(
    policy: Any, recording: RecordedObservations, act: Callable[[Mapping[str, np.ndarray]], np.ndarray]
) -> np.ndarray:
    """What ``act`` returns in each step, between resets of the policy; shape (steps, worlds, actions)."""
    actions = []
    policy.reset()
    for step, begins in enumerate(recording.begins):
        if step and begins.any():
            policy.reset(torch.from_numpy(begins))
        actions.append(act({name: np.ascontiguousarray(each[step]) for name, each in recording.inputs.items()}))
    return np.stack(actions)


def difference(found: np.ndarray, expected: np.ndarray) -> float:
    """The greatest difference of two arrays of actions: absolute up to 1, relative beyond. NaN where one is not a number."""
    return float((np.abs(found - expected) / np.maximum(1.0, np.abs(expected))).max())


def compare(what: str, policy: OnnxPolicy, recording: RecordedObservations, trained: np.ndarray) -> float:
    """The greatest difference of an exported policy to the trained one's actions. Raises TrainingError above the tolerance."""
    found = difference(_actions(policy, recording, policy.run), trained)
    if not found <= TOLERANCE:
        raise TrainingError(
            f"the exported policy ({what}) differs from the trained one by {found:g} (at most {TOLERANCE:g} is allowed); not published"
        )
    return found


def refuse_hidden_memory(
    policy: Policy, exported: ExportedPolicy, algorithm: str, recording: RecordedObservations, groups: Mapping[str, str]
) -> None:
    """Raise UserError where the policy acts otherwise after other observations, and its module has no recurrent state."""
    if exported.states:
        return
    last = RecordedObservations({name: each[-1:] for name, each in recording.inputs.items()}, recording.begins[:1])
    fresh, after = trained_actions(policy, last, groups)[0], trained_actions(policy, recording, groups)[-1]
    if difference(fresh, after) > TOLERANCE:
        raise UserError(
            f"the policy of algorithm {algorithm} remembers what it saw before, but its module() has no recurrent state among "
            "inputs and outputs; not published"
        )
