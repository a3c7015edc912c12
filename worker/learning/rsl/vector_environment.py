"""Tasks as vector environments of rsl_rl, for your own runner scripts::

    from rsl_rl.runners import OnPolicyRunner
    from worker.learning.rsl.vector_environment import make

    runner = OnPolicyRunner(make("Cartpole", 64, seed=1), config, "logs", "cpu")
    runner.learn(100, init_at_random_ep_len=True)

Observation groups are ``policy``, ``critic`` and the task's own, such as a camera's. Images become float32 from -0.5 to 0.5, shape
(worlds, channels, height, width), since rsl_rl's convolutions take floats and a task returns bytes.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

import torch
from rsl_rl.env import VecEnv
from tensordict import TensorDict

from worker.learning.observations import to_numbers
from worker.tasks import find_task

if TYPE_CHECKING:
    from worker.tasks.run.task import Task


class TaskVecEnv(VecEnv):
    """A task as rsl_rl's ``VecEnv``; its control step stays a CUDA graph.

    Args:
        task: The task; the environment returns copies of its buffers.

    Attributes:
        cfg: The task's configuration, as plain values.
        step_dt: Length of a control step [s], by which rsl_rl scales intrinsic rewards.
    """

    def __init__(self, task: Task) -> None:
        self.task, self.cfg = task, _plain(task.config)
        self.num_envs, self.num_actions, self.device = task.world_count, task.action_size, task.device
        self.max_episode_length = task.max_episode_length
        self.step_dt = 1.0 / task.config.control_hz
        self._terms = [name for name in task.statistic_names if name.startswith("reward_")]
        self._columns = [task.statistic_names.index(name) for name in self._terms]

    @property
    def unwrapped(self) -> TaskVecEnv:
        """This environment, since rsl_rl looks for :attr:`step_dt` behind wrappers."""
        return self

    @property
    def episode_length_buf(self) -> torch.Tensor:
        """Steps on the clock of each running episode, shape (worlds,), int32. Setting it sets the task's clocks."""
        return self.task.episode_length

    @episode_length_buf.setter
    def episode_length_buf(self, steps: torch.Tensor) -> None:
        self.task.episode_length.copy_(steps)

    def get_observations(self) -> TensorDict:
        """Every observation group, shape (worlds, ...), float32."""
        return as_floats(self.task.groups, self.task.groups)

    def step(self, actions: torch.Tensor) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict[str, Any]]:
        """Advance every world by one control step; worlds whose episode ends begin the next one.

        Args:
            actions: Shape (worlds, actions), float32.

        Returns:
            Observations as :meth:`get_observations` gives them, rewards, shape (worlds,), float32, whether episodes ended, shape
            (worlds,), int64, and ``time_outs``, shape (worlds,), float32. If episodes ended, ``log`` has each reward term's sum over an
            episode, averaged over the ended episodes and repeated once for each of them: shape (episodes,), float32.
        """
        before = self.task.statistics.clone()
        self.task.step(actions)
        extras: dict[str, Any] = {"time_outs": self.task.time_outs.float()}
        if self._terms and (ended := int(self.task.dones.sum())):
            means = ((self.task.statistics - before) / ended).float()
            extras["log"] = {
                name: means[column].expand(ended) for name, column in zip(self._terms, self._columns, strict=True)
            }
        return self.get_observations(), self.task.rewards.clone(), self.task.dones.long(), extras


def make(task: str, num_envs: int = 1, *, seed: int = 0, device: str = "cpu", **config: Any) -> TaskVecEnv:
    """A task's worlds as an environment of rsl_rl.

    Args:
        task: Name or ``module:Class``, as :func:`worker.tasks.find_task` takes it.
        num_envs: Number of worlds.
        seed: Seed of the worlds.
        device: ``"cpu"`` or ``"cuda:<n>"``.
        **config: Fields of the task's configuration, by name.

    Raises:
        ValueError: The task or a field of its configuration does not exist, or a value is out of range.
    """
    task_type = find_task(task)
    known = {item.name for item in dataclasses.fields(task_type.config_type)}
    if unknown := sorted(config.keys() - known):
        raise ValueError(
            f"task {task} has no setting {', '.join(unknown)}; its settings are {', '.join(sorted(known))}"
        )
    return TaskVecEnv(task_type(task_type.config_type(**config), num_envs, seed=seed, device=device))


def as_floats(observations: Mapping[str, torch.Tensor] | TensorDict, groups: Iterable[str]) -> TensorDict:
    """Copies of ``groups`` in the form that rsl_rl expects.

    Args:
        observations: Observations of a task: shape (worlds, ...), float32, images uint8. The task overwrites its buffers in the next
            step, while rsl_rl keeps observations for longer.
        groups: Names of the groups to copy.

    Returns:
        float32, images from -0.5 to 0.5; batch size (worlds,).
    """
    own = {name: observations[name] for name in groups}
    copies = {name: to_numbers(each) if each.dtype == torch.uint8 else each.clone() for name, each in own.items()}
    first = next(iter(copies.values()))
    return TensorDict(copies, batch_size=first.shape[:1], device=first.device)


def _plain(value: Any) -> Any:
    """A configuration as dictionaries, lists and numbers, for logs."""
    if dataclasses.is_dataclass(value):
        return {item.name: _plain(getattr(value, item.name)) for item in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {name: _plain(each) for name, each in value.items()}
    return value
