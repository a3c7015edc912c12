"""Tasks as Gymnasium vector environments: ``gymnasium.make_vec("worker.tasks.run.gym:Muster/Cartpole-v0", num_envs=64)``.

Gymnasium 1.4 does not load plugins by itself: importing this module registers the built-in tasks, and the ``module:`` prefix
of the id imports it. After that, ``"Muster/Cartpole-v0"`` is enough.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from worker.tasks.run.find import BUILT_IN, find_task
from worker.tasks.run.task import Task

Observations = np.ndarray | dict[str, np.ndarray]


class TaskVectorEnv(VectorEnv[Observations, np.ndarray, np.ndarray]):
    """A task as a vector environment with numpy inputs and outputs.

    A world whose episode ends is reset in the same step: the step returns the first observation of the next episode, and
    ``info["final_obs"][world]`` holds the last one of the old (None in other worlds; ``info["_final_obs"]`` is the mask); for images,
    the one before the last step.

    An observation is an array; for a task with both images and numbers, a dictionary of arrays: ``policy``, and each image group.
    The action space has the limits to which the task clips its actions; an action that it does not clip has none.

    Args:
        task: Name or ``module:Class``, as for :func:`worker.tasks.find_task`.
        num_envs: Number of worlds.
        seed: Seed until :meth:`reset` sets another.
        device: ``"cpu"`` or ``"cuda:<n>"``.
        **overrides: Fields of the task's configuration, by name.

    Raises:
        ValueError: The task or a field of its configuration does not exist, or a value is out of range.
    """

    metadata: dict[str, Any] = {"autoreset_mode": AutoresetMode.SAME_STEP, "render_modes": []}

    def __init__(self, task: str, num_envs: int = 1, *, seed: int = 0, device: str = "cpu", **overrides: Any) -> None:
        task_type = find_task(task)
        known = {item.name for item in dataclasses.fields(task_type.config_type)}
        if unknown := sorted(overrides.keys() - known):
            raise ValueError(
                f"task {task} has no setting {', '.join(unknown)}; its settings are {', '.join(sorted(known))}"
            )
        config = task_type.config_type(**overrides)
        self.task = task_type(config, num_envs, seed=seed, device=device)
        self.num_envs = num_envs
        self.metadata = {**self.metadata, "render_fps": config.control_hz}
        groups = self.task.groups
        self._image_groups = [name for name, group in groups.items() if group.dtype == torch.uint8]
        self._several = any(name != "policy" for name in self._image_groups)
        spaces = {name: _space(groups[name]) for name in dict.fromkeys(("policy", *self._image_groups))}
        self.single_observation_space: gymnasium.Space[Any] = (
            gymnasium.spaces.Dict(spaces) if self._several else spaces["policy"]
        )
        self._images = {name: self._numpy(groups[name]) for name in self._image_groups}
        self.single_action_space: gymnasium.Space[Any] = _action_space(self.task)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observations, dict[str, Any]]:
        """Begin a new episode in every world.

        Args:
            seed: The worlds become those of this seed, as if they had just been built; only the scenes that
                ``config.randomize`` drew at the construction stay. None: their random streams continue.
            options: Not used by any task.

        Returns:
            Observations, shape ``(num_envs, observations)``, float32 (images ``(num_envs, channels, height, width)``, uint8),
            in a dictionary for a task with both images and numbers, and an empty info.

        Raises:
            ValueError: ``seed`` is negative, or ``options`` asks for a partial reset, which worlds do by themselves.
        """
        if options is not None and "reset_mask" in options:
            raise ValueError("reset_mask is for environments that do not reset themselves; these do, in the same step")
        if seed is not None:
            self.task.restart(seed, self.task.first_world)
            super().reset(seed=seed)
        else:
            self.task.reset()
        return self._observe(), {}

    def step(self, actions: np.ndarray) -> tuple[Observations, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Advance every world by one control step.

        Args:
            actions: Shape ``(num_envs, actions)``, clipped to the limits of :attr:`single_action_space`; of choices ``(num_envs,)``.

        Returns:
            Observations (float32, images uint8), rewards (float32), terminations, truncations (bool) and info.

        Raises:
            ValueError: ``actions`` has another shape.
        """
        actions = np.asarray(actions, dtype=np.float32)
        if actions.shape != self.action_space.shape:
            raise ValueError(
                f"actions have shape {actions.shape}; {self.num_envs} worlds take {self.action_space.shape}"
            )
        self.task.step(torch.from_numpy(actions).view_as(self.task.actions))
        dones = self._numpy(self.task.dones)
        truncations = self._numpy(self.task.time_outs)
        info: dict[str, Any] = {}
        if dones.any():
            # no image is rendered between a world's end and its reset; the previous one takes its place
            terminal = self._images
            if "policy" not in terminal:
                terminal = {"policy": self._numpy(self.task.terminal_observations), **terminal}
            final_obs = np.full(self.num_envs, None, dtype=object)
            for world in np.flatnonzero(dones):
                last = {name: group[world] for name, group in terminal.items()}
                final_obs[world] = last if self._several else last["policy"]
            info = {"final_obs": final_obs, "_final_obs": dones.copy(), "final_info": {}, "_final_info": dones.copy()}
        return (
            self._observe(),
            self._numpy(self.task.rewards),
            dones & ~truncations,
            truncations,
            info,
        )

    def _observe(self) -> Observations:
        self._images = {name: self._numpy(self.task.groups[name]) for name in self._image_groups}
        policy = self._images["policy"] if "policy" in self._images else self._numpy(self.task.observations)
        return {"policy": policy, **self._images} if self._several else policy

    @staticmethod
    def _numpy(tensor: torch.Tensor) -> np.ndarray:
        """A copy, since the task's buffers change with the next step."""
        return tensor.cpu().numpy().copy()


def _action_space(task: Task) -> gymnasium.Space[Any]:
    """The space of one world's actions."""
    if task.discrete:
        return gymnasium.spaces.Discrete(task.action_size)
    limits = [action.clip or (-np.inf, np.inf) for action in task.interface().actions]
    low, high = np.array(limits, np.float32).T
    return gymnasium.spaces.Box(low, high, dtype=np.float32)


def _space(group: torch.Tensor) -> gymnasium.Space[Any]:
    """The space of one world's part of an observation group."""
    shape = tuple(group.shape[1:])
    if group.dtype == torch.uint8:
        return gymnasium.spaces.Box(0, 255, shape, np.uint8)
    return gymnasium.spaces.Box(-np.inf, np.inf, shape, np.float32)


def register() -> None:
    """Register ``Muster/<Task>-v0`` for every built-in task (once; a second call does nothing)."""
    for name in BUILT_IN:
        if f"Muster/{name}-v0" not in gymnasium.registry:
            gymnasium.register(
                id=f"Muster/{name}-v0",
                vector_entry_point="worker.tasks.run.gym:TaskVectorEnv",
                kwargs={"task": name},
            )


register()
