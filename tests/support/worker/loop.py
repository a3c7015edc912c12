"""The training loop at its smallest: an algorithm and a task's worlds in this process."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from tensordict import TensorDict

from worker.learning.algorithm import Algorithm, LearningSetting, Policy, Spaces, Transition, WorldShare
from worker.learning.distributed import Gang, RankPlacement


def alone(device: str = "cpu") -> Gang:
    """A gang of one."""
    return Gang(RankPlacement(), device, None, ["here"])


def groups(task: Any, terminal: bool = False) -> TensorDict:
    """The task's observation groups, or, of a test double, its observations as the group ``policy``."""
    name = "terminal_groups" if terminal else "groups"
    one = task.terminal_observations if terminal else task.observations
    return TensorDict(getattr(task, name, {"policy": one}), batch_size=[task.world_count])


def spaces_of(task: Any) -> Spaces:
    """What goes into a policy for the task and what comes out."""
    return Spaces({name: tuple(group.shape[1:]) for name, group in groups(task).items()}, task.action_size)


def setting_of(task: Any, seed: int = 0, gang: Gang | None = None, share: WorldShare | None = None) -> LearningSetting:
    """Where an algorithm learns that has all the task's worlds, or ``share``."""
    every = WorldShare(0, task.world_count, task.world_count)
    return LearningSetting(spaces_of(task), share or every, gang or alone(), seed)


def transition_of(task: Any) -> Transition:
    """What the task's last step gave."""
    return Transition(groups(task), groups(task, terminal=True), task.rewards, task.dones, task.time_outs)


def iterate(algorithm: Algorithm, task: Any, first: int, last: int) -> Mapping[str, torch.Tensor]:
    """Iterations ``[first, last)``; the metrics of the last one."""
    metrics: Mapping[str, torch.Tensor] = {}
    for iteration in range(first, last):
        algorithm.begin(iteration)
        for _ in range(algorithm.steps):
            task.step(algorithm.act(groups(task)))
            algorithm.record(transition_of(task))
        metrics = algorithm.learn(groups(task))
    return metrics


def mean_return(policy: Policy, task: Any) -> float:
    """Of the episodes that end while every world lives through the longest one, from a start of its own."""
    task.reset()
    task.clear_statistics()
    for _ in range(task.max_episode_length):
        task.step(policy.act(groups(task)))
    episodes, returns, *_ = task.statistics.tolist()
    return float(returns / episodes)
