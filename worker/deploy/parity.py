"""The parity of an exported policy with the trained one: in each action on observations of real roll-outs, their extremes and made-up ones;
and in how well both do on the same worlds."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from tensordict import TensorDict

from worker.evaluation import episodes
from worker.evaluation.episodes import Episodes
from worker.learning.algorithm import Acting
from worker.learning.distributed import Gang, RankPlacement
from worker.learning.setup import observed
from worker.settings.errors import TrainingError, UserError

if TYPE_CHECKING:
    from worker.deploy.model_file import OnnxPolicy
    from worker.learning.algorithm import ExportedPolicy, Policy
    from worker.tasks.run.task import Task


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


RECORDED_WORLDS, RECORDED_STEPS = 4, 256
"""Worlds and steps of a recording: 1,024 observations."""
LARGEST = 128 << 20
"""Bytes of a recording; of large images it has fewer steps."""
SHARE, ERRORS = 0.01, 2.0
"""Tolerance between the means of the bundle and of the trained policy: a share of the latter, or a number of standard errors."""


class Extremes:
    """A policy, and the observations in which some number was the least or the greatest that it has seen.

    Args:
        policy: On the task's device.
        groups: The observation group of each input of the policy.
    """

    def __init__(self, policy: Acting, groups: Mapping[str, str]) -> None:
        self._policy, self._groups = policy, groups
        self._best: dict[tuple[str, bool], torch.Tensor] = {}
        self._rows: dict[tuple[str, bool], dict[str, torch.Tensor]] = {}

    def act(self, observations: TensorDict) -> torch.Tensor:
        """The policy's actions for observations, which are taken in."""
        for key in ((name, greatest) for name in self._groups for greatest in (False, True)):
            numbers = observations[self._groups[key[0]]]
            values, worlds = (numbers if key[1] else -numbers).max(dim=0)
            rows = {name: observations[group][worlds] for name, group in self._groups.items()}
            if key not in self._best:
                self._best[key], self._rows[key] = values.clone(), rows
                continue
            better = values > self._best[key]
            self._best[key][better] = values[better]
            for name, kept in self._rows[key].items():
                kept[better] = rows[name][better]
        return self._policy.act(observations)

    def reset(self, worlds: torch.Tensor | None = None) -> None:
        """As that of the policy."""
        self._policy.reset(worlds)

    def inputs(self) -> dict[str, np.ndarray]:
        """By name of the input, shape (n, …), each observation once."""
        joined = {name: torch.cat([rows[name] for rows in self._rows.values()]).cpu() for name in self._groups}
        flat = torch.cat([each.flatten(1) for each in joined.values()], dim=1).numpy()
        _, first = np.unique(flat, axis=0, return_index=True)
        return {name: each.numpy()[np.sort(first)] for name, each in joined.items()}


def record(task: Task, policy: Acting, groups: Mapping[str, str]) -> RecordedObservations:
    """Let ``policy`` act, and keep what it sees in the first worlds; all episodes begin anew at the start and in the middle.

    Args:
        task: The worlds, which are left as they are then.
        policy: On the task's device.
        groups: The observation group of each input.
    """
    worlds = min(RECORDED_WORLDS, task.world_count)
    steps = RECORDED_STEPS * RECORDED_WORLDS // worlds
    each = sum(task.groups[group][0].nbytes for group in groups.values()) * worlds
    steps = max(2, min(steps, LARGEST // each))
    kept: dict[str, list[np.ndarray]] = {name: [] for name in groups}
    begins = np.zeros((steps, worlds), dtype=bool)
    observations = observed(task)
    for step in range(steps):
        if step in (0, steps // 2):
            task.reset()
            policy.reset()
            begins[step] = True
        for name, group in groups.items():
            kept[name].append(observations[group][:worlds].cpu().numpy().copy())
        task.step(policy.act(observations))
        policy.reset(task.dones)
        if step + 1 < steps:
            begins[step + 1] = task.dones[:worlds].cpu().numpy()
    return RecordedObservations({name: np.stack(rows) for name, rows in kept.items()}, begins)


def play(task: Task, policy: Acting, rounds: int) -> Episodes:
    """Whole episodes from a fresh reset, ``rounds`` of each world, at least 1, without noise, as an evaluation plays them."""
    return episodes.play([task] * rounds, policy, Gang(RankPlacement(), task.device, None, ["here"]))


def judge(trained: Episodes, bundle: Episodes) -> dict[str, Any]:
    """Both results, and how far they may differ. Raises TrainingError where the bundle's is farther from the trained policy's.

    A difference of a rounding error grows in the course of an episode with contacts, so single episodes may differ; their means may not.
    """
    found = _compare("mean return", trained.returns, bundle.returns)
    if trained.successes is not None and bundle.successes is not None:
        found["success"] = _compare("share of successes", trained.successes, bundle.successes)
    return {"episodes": len(trained.rows), "trained": _facts(trained), "bundle": _facts(bundle), **found}


def _compare(what: str, trained: torch.Tensor, bundle: torch.Tensor) -> dict[str, Any]:
    """How far the means of two columns, a number for each episode, are apart and may be. Raises TrainingError if they are farther apart."""
    a, b = trained.double().numpy(), bundle.double().numpy()
    tolerance = max(SHARE * abs(a.mean()), ERRORS * math.sqrt((a.var() + b.var()) / len(a)))
    apart = float(abs(a.mean() - b.mean()))
    if not apart <= tolerance:
        raise TrainingError(
            f"the bundle does not do what the trained policy does: its {what} over {len(b)} episodes is {b.mean():g}, the trained "
            f"policy's on the same worlds {a.mean():g} (at most {tolerance:g} apart is allowed); not published"
        )
    return {"difference": apart, "tolerance": float(tolerance)}


def _facts(played: Episodes) -> dict[str, float | None]:
    """Figures for the report; ``success`` is a share, or None where the task does not say what a success is."""
    return {
        "mean_return": float(played.returns.mean()),
        "std_return": float(played.returns.std(correction=0)),
        "mean_length": float(played.lengths.mean()),
        "success": None if played.successes is None else float(played.successes.double().mean()),
    }
