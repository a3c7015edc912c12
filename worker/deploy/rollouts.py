"""Roll-outs of a task for a bundle: what its policy is compared on, and how well trained and exported policy do on the same worlds."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import torch
from tensordict import TensorDict

from worker.deploy.parity import Recording
from worker.errors import TrainingError

if TYPE_CHECKING:
    from worker.tasks.task import Task

RECORDED_WORLDS, RECORDED_STEPS = 4, 256
"""Worlds and steps of a recording: 1,024 observations."""
LARGEST = 128 << 20
"""Bytes of a recording; of large images it has fewer steps."""
SHARE, ERRORS = 0.01, 2.0
"""Tolerance between the mean returns of the bundle and of the trained policy: a share of it, or a number of standard errors."""


class Acting(Protocol):
    """A policy, trained or from a file."""

    def act(self, observations: TensorDict) -> torch.Tensor: ...

    def reset(self, worlds: Any = None) -> None: ...


@dataclass(frozen=True)
class Played:
    """Whole episodes, one entry for each."""

    returns: np.ndarray
    lengths: np.ndarray
    """In control steps."""

    def facts(self) -> dict[str, float]:
        """Figures for the report."""
        return {
            "mean_return": float(self.returns.mean()),
            "std_return": float(self.returns.std()),
            "mean_length": float(self.lengths.mean()),
        }


class Extremes:
    """The observations in which some number was the least or the greatest that was seen.

    Args:
        groups: The observation group of each input of the policy.
    """

    def __init__(self, groups: Mapping[str, str]) -> None:
        self._groups = groups
        self._best: dict[tuple[str, bool], torch.Tensor] = {}
        self._rows: dict[tuple[str, bool], dict[str, torch.Tensor]] = {}

    def look(self, observations: TensorDict) -> None:
        """Take in one step."""
        for name, group in self._groups.items():
            for greatest in (False, True):
                numbers = observations[group] if greatest else -observations[group]
                values, worlds = numbers.max(dim=0)
                rows = {each: observations[there][worlds] for each, there in self._groups.items()}
                key = name, greatest
                if key not in self._best:
                    self._best[key], self._rows[key] = values.clone(), rows
                    continue
                better = values > self._best[key]
                self._best[key][better] = values[better]
                for each, kept in self._rows[key].items():
                    kept[better] = rows[each][better]

    def inputs(self) -> dict[str, np.ndarray]:
        """By name of the input, shape (n, …), each observation once."""
        joined = {name: torch.cat([rows[name] for rows in self._rows.values()]).cpu() for name in self._groups}
        flat = torch.cat([each.flatten(1) for each in joined.values()], dim=1).numpy()
        _, first = np.unique(flat, axis=0, return_index=True)
        return {name: each.numpy()[np.sort(first)] for name, each in joined.items()}


def seen(task: Task) -> TensorDict:
    """The task's observation groups, live, batch size (worlds,)."""
    return TensorDict(dict(task.groups), [task.world_count], device=task.device)


def record(task: Task, policy: Acting, groups: Mapping[str, str]) -> Recording:
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
    observations = seen(task)
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
    return Recording({name: np.stack(rows) for name, rows in kept.items()}, begins)


def play(task: Task, policy: Acting, rounds: int, extremes: Extremes | None = None) -> Played:
    """Whole episodes from a fresh reset, ``rounds`` of each world, without noise.

    Args:
        task: The worlds.
        policy: On the task's device.
        rounds: At least 1.
        extremes: Is shown every observation of episodes that are still running.
    """
    results = []
    observations = seen(task)
    for _ in range(rounds):
        task.reset()
        policy.reset()
        result = torch.zeros(task.world_count, 2, dtype=torch.float64, device=task.device)
        running = torch.ones(task.world_count, dtype=torch.bool, device=task.device)
        for step in range(task.max_episode_length):
            if extremes is not None:
                extremes.look(observations)
            task.step(policy.act(observations))
            policy.reset(task.dones)
            result[:, 0] += torch.where(running, task.rewards, 0.0)
            result[:, 1] += running
            running &= task.dones == 0
            if step % 32 == 31 and not bool(running.any()):  # looking waits for the device, so look seldom
                break
        results.append(result.cpu())
    returns, lengths = torch.cat(results).unbind(1)
    return Played(returns.numpy(), lengths.numpy())


def judge(trained: Played, bundle: Played) -> dict[str, Any]:
    """Both results, and how far they may differ. Raises TrainingError where the bundle's is farther from the trained policy's.

    A difference of a rounding error grows in the course of an episode with contacts, so single episodes may differ; their mean may not.
    """
    a, b = trained.returns, bundle.returns
    tolerance = max(SHARE * abs(a.mean()), ERRORS * math.sqrt((a.var() + b.var()) / len(a)))
    apart = float(abs(a.mean() - b.mean()))
    if not apart <= tolerance:
        raise TrainingError(
            f"the bundle does not do what the trained policy does: its mean return over {len(b)} episodes is {b.mean():g}, the trained "
            f"policy's on the same worlds {a.mean():g} (at most {tolerance:g} apart is allowed); not published"
        )
    return {
        "episodes": len(a),
        "trained": trained.facts(),
        "bundle": bundle.facts(),
        "difference": apart,
        "tolerance": float(tolerance),
    }
