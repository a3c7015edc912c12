"""A small loop for rsl_rl's algorithms: what Muster's own does with them, without files, logs and graphs."""

from __future__ import annotations

import dataclasses
import io
from collections.abc import Iterable
from typing import Any

import torch
from rsl_rl.models import MLPModel
from tensordict import TensorDict
from torch import nn

from tests.support.worker.loop import groups, setting_of, transition_of
from tests.support.worker.point_task import Point, PointConfig
from worker.learning import algorithms
from worker.learning.algorithm import WorldShare
from worker.learning.distributed import Gang
from worker.learning.randomness import generator_state, restore_generators
from worker.learning.rsl.algorithm import RslRl
from worker.settings.rsl_rl import RslRlConfig
from worker.settings.task import TaskConfig

GAUSSIAN = {"class_name": "GaussianDistribution"}
GRU = {"class_name": "RNNModel", "rnn_type": "gru", "rnn_hidden_dim": 8, "hidden_dims": [8], "obs_normalization": True}
"""A small network with memory."""
CURIOUS = {"num_outputs": 4, "predictor_hidden_dims": [8], "target_hidden_dims": [8], "weight": 1.0}
SECTIONS: dict[str, dict[str, Any]] = {
    "PPO with RND": {
        "algorithm": {"rnd_cfg": {**CURIOUS, "state_normalization": True, "reward_normalization": True}},
        "actor": {"class_name": f"{__name__}:Batched", "distribution_cfg": GAUSSIAN},
    },
    "GRU": {"actor": {**GRU, "distribution_cfg": GAUSSIAN}, "algorithm": {"num_mini_batches": 2}},
    "distillation": {
        "algorithm": {"class_name": "Distillation", "gradient_length": 8},
        "student": {**GRU, "distribution_cfg": GAUSSIAN},
        "teacher_checkpoint": "taught",
    },
}
"""With what ranks have to share beside gradients: running statistics, curiosity, memory, a teacher."""


class GroupedPoint(Point):
    """The point, with observation groups: the policy may see less than the critic."""

    def __init__(self, config: PointConfig | None = None, world_count: int = 8, **arguments: Any) -> None:
        super().__init__(config or PointConfig(), world_count, **arguments)
        self.groups = {"policy": self.observations, "critic": self.observations, "place": self.observations[:, :1]}
        self.terminal_groups = {"policy": self.terminal_observations, "critic": self.terminal_observations}


def settings(section: dict[str, Any]) -> RslRlConfig:
    """The settings of a job's ``rsl_rl`` section, as a rank reads them."""
    read: RslRlConfig = algorithms.settings(RslRl, "rsl_rl", TaskConfig(), {"rsl_rl": section})
    return read


def build(task: Any, section: dict[str, Any], gang: Gang | None = None, share: WorldShare | None = None) -> RslRl:
    """The algorithm that a job's ``rsl_rl`` section describes, for ``task``."""
    setting = setting_of(task, 1, gang, share)
    return RslRl(settings(section), dataclasses.replace(setting, control_seconds=1.0 / task.config.control_hz))


def train(algorithm: RslRl, task: Any, iterations: int, done: int = 0) -> list[dict[str, float]]:
    """Iterations ``done``, ``done + 1``, …; the metrics of each, with the ``reward`` of a step."""
    records = []
    for iteration in range(done, done + iterations):
        algorithm.begin(iteration)
        rewards = 0.0
        for _ in range(algorithm.steps):
            task.step(algorithm.act(groups(task)))
            algorithm.record(transition_of(task))
            rewards += float(task.rewards.mean()) / algorithm.steps
        metrics = algorithm.learn(groups(task))
        records.append({"reward": rewards, **{name: float(value) for name, value in metrics.items()}})
    return records


def evaluate(policy: Any, task: Any) -> tuple[float, float]:
    """Mean return and mean length of each world's first episode after a reset, with the policy's best actions."""
    task.reset()
    policy.reset()
    running = torch.ones(task.world_count)
    returns, lengths = torch.zeros(task.world_count), torch.zeros(task.world_count)
    for _ in range(task.max_episode_length):
        task.step(policy.act(groups(task)))
        policy.reset(task.dones)
        returns += running * task.rewards
        lengths += running
        running *= ~task.dones
    return float(returns.mean()), float(lengths.mean())


def save(algorithm: RslRl, task: Any) -> bytes:
    """All that a checkpoint has."""
    buffer = io.BytesIO()
    state = {"learner": dict(algorithm.state_dict()), "worlds": dict(algorithm.world_state())}
    torch.save({**state, "task": task.state_dict(), "generators": generator_state()}, buffer)
    return buffer.getvalue()


def restore(algorithm: RslRl, task: Any, saved: bytes) -> None:
    """Go on from :func:`save`."""
    state = torch.load(io.BytesIO(saved), weights_only=True)
    algorithm.load_state_dict(state["learner"])
    algorithm.load_world_state(state["worlds"])
    task.load_state_dict(state["task"])
    restore_generators(state["generators"])


class Seen(GroupedPoint):
    """The point with an image beside its numbers: a bright column where it stands."""

    def __init__(self, **arguments: Any) -> None:
        super().__init__(PointConfig(episode_seconds=0.5), 8, **arguments)
        self.groups["image"] = torch.zeros(8, 2, 9, 9, dtype=torch.uint8)
        self._draw_image()

    def step(self, actions: torch.Tensor) -> None:
        super().step(actions)
        self._draw_image()

    def _draw_image(self) -> None:
        columns = (self.place * 1.5 + 4.5).long().clamp(0, 8)
        self.groups["image"].zero_()[torch.arange(8), :, :, columns] = 255

    def state_tensors(self) -> dict[str, torch.Tensor]:
        return {**super().state_tensors(), "image": self.groups["image"]}


class Batched(MLPModel):
    """A network with running statistics that rsl_rl does not know of."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self.mlp = nn.Sequential(nn.BatchNorm1d(self.obs_dim), self.mlp)  # type: ignore[assignment]  # rsl_rl wants its own MLP


def mirror(env: Any, obs: TensorDict | None, actions: torch.Tensor | None) -> tuple[Any, Any]:
    """A symmetry function: left and right of the cart-pole, and of the point, are the same but for the sign."""
    both = None
    if obs is not None:
        groups: Iterable[tuple[str, Any]] = obs.items()
        both = TensorDict({name: torch.cat((group, -group)) for name, group in groups}, [2 * obs.batch_size[0]])
    return both, None if actions is None else torch.cat((actions, -actions))
