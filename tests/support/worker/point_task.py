"""A test double for the *learning* tests: a point on a line, in plain torch, with the interface of a task.

Every draw is a function of (seed, global world index, draws so far), as in the real tasks, and all state is in ``state_dict``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType, SimpleNamespace
from typing import Any

import torch

from worker.settings.ppo import PPOConfig
from worker.settings.task import Randomization
from worker.tasks.compile.binding import Bound
from worker.tasks.compile.numbers import Numbers
from worker.tasks.compile.plan import Seen
from worker.tasks.declare.declaration import Observation
from worker.tasks.declare.interface import Interface
from worker.tasks.run.task_report import TaskReport


@dataclass(frozen=True)
class PointPPO(PPOConfig):
    steps: int = 8
    hidden_sizes: tuple[int, ...] = (16, 16)
    epochs: int = 2
    minibatches: int = 2
    entropy_coef: float = 0.001


@dataclass(frozen=True)
class PointConfig:
    control_hz: float = 10.0
    episode_seconds: float = 2.0
    limit: float = 3.0
    poison_at: int = 0
    """Rewards are NaN from this step of the task on; 0 never."""
    sleep: float = 0.0
    """How long a step takes [s]."""
    nan_limit: float = 0.1
    randomize: Randomization = field(default_factory=Randomization)
    curriculum: Mapping[str, list[list[float]]] = field(default_factory=dict)
    ppo: PointPPO = field(default_factory=PointPPO)


class Point(TaskReport):
    """Push a point to the middle: 2 observations (place, velocity), 1 action."""

    config_type = PointConfig
    statistic_names: tuple[str, ...] = (
        "episodes",
        "episode_return",
        "episode_length",
        "reward_place",
        "squared_return",
    )
    final_metrics = ()
    shown_metrics = MappingProxyType[str, str]({})
    action_size, discrete, observation_shape = 1, False, (2,)
    action_names = ("push",)
    readings = MappingProxyType[str, Any]({})
    observation_names = ("place", "velocity")
    ended = None
    adapting = None

    def bundle_documents(self, algorithm: str) -> Mapping[str, Mapping[str, Any]]:
        return {}

    def __init__(
        self, config: PointConfig, world_count: int, *, seed: int = 0, first_world: int = 0, device: str = "cpu"
    ) -> None:
        self.config, self.world_count, self.device = config, world_count, device
        self.max_episode_length = round(config.control_hz * config.episode_seconds)
        self._key = (torch.arange(first_world, first_world + world_count) * 7919 + seed % 2**32 * 104729).double()
        self._draws = torch.zeros(world_count, dtype=torch.float64)
        self._steps = torch.zeros(world_count, dtype=torch.int64)
        self.place, self.velocity = torch.zeros(world_count), torch.zeros(world_count)
        self._sums = torch.zeros(world_count)
        self.observations = torch.zeros(world_count, 2)
        self.terminal_observations = torch.full((world_count, 2), float("nan"))
        self.groups = {"policy": self.observations, "critic": self.observations}
        self.terminal_groups = {"policy": self.terminal_observations, "critic": self.terminal_observations}
        self.actions = torch.zeros(world_count, 1)
        self.rewards = torch.zeros(world_count)
        self.dones = torch.zeros(world_count, dtype=torch.bool)
        self.time_outs = torch.zeros(world_count, dtype=torch.bool)
        self.episode_length = torch.zeros(world_count, dtype=torch.int32)
        self.statistics = torch.zeros(5, dtype=torch.float64)
        self.failed_world = torch.zeros(1, dtype=torch.int32)
        self.reset()

    def _draw(self, mask: torch.Tensor) -> torch.Tensor:
        """One number in [0, 1) for each world of ``mask``."""
        value = torch.sin(self._key * 12.9898 + self._draws * 78.233) * 43758.5453
        self._draws += mask
        return (value - value.floor()).float()

    def _restart(self, mask: torch.Tensor) -> None:
        self.place.copy_(torch.where(mask, 4.0 * self._draw(mask) - 2.0, self.place))
        self.velocity.masked_fill_(mask, 0.0)
        self._sums.masked_fill_(mask, 0.0)
        self.episode_length.masked_fill_(mask, 0)
        self.observations.copy_(torch.stack((self.place, self.velocity), 1))

    def reset(self) -> None:
        self._restart(torch.ones(self.world_count, dtype=torch.bool))

    def set_random_episode_length(self) -> None:
        draw = self._draw(torch.ones(self.world_count, dtype=torch.bool))
        self.episode_length.copy_((draw * self.max_episode_length).int())

    def step(self, actions: torch.Tensor) -> None:
        if self.config.sleep:
            import time

            time.sleep(self.config.sleep)
        self.velocity.mul_(0.8).add_(0.3 * actions[:, 0].clamp(-1.0, 1.0))
        self.place.add_(self.velocity)
        self.episode_length += 1
        self._steps += 1
        self.rewards.copy_(1.0 - self.place.abs())
        if self.config.poison_at:
            self.rewards.masked_fill_(self._steps >= self.config.poison_at, float("nan"))
        self._sums += self.rewards
        fallen = self.place.abs() > self.config.limit
        self.time_outs.copy_((self.episode_length >= self.max_episode_length) & ~fallen)
        self.dones.copy_(fallen | self.time_outs)
        self.terminal_observations.copy_(torch.stack((self.place, self.velocity), 1))
        ended = self.dones.double()
        returns, lengths = (self._sums * ended).sum(), (self.episode_length * ended).sum()
        squares = (self._sums * ended).double().square().sum()
        self.statistics += torch.stack((ended.sum(), returns, lengths, returns, squares))
        self._restart(self.dones)

    def clear_statistics(self) -> None:
        self.statistics.zero_()

    def begin_iteration(self, iteration: int, reward: float | None, episode_length: float | None) -> None:
        pass

    def interface(self) -> Interface:
        return Interface((), ())

    @property
    def plan(self) -> Any:
        """As much of a plan as a contract reads: a term for each observation."""
        seen = [
            Seen(Bound(f"observations.{name}", Observation(Point.step), None), [name], column, None, None, [], None, -1)
            for column, name in enumerate(self.observation_names)
        ]
        return SimpleNamespace(groups={"policy": seen}, images={}, commands=(), numbers=Numbers())

    def state_tensors(self) -> dict[str, torch.Tensor]:
        names = ("place", "velocity", "observations", "episode_length", "_draws", "_steps", "_sums")
        return {name: getattr(self, name) for name in names}

    def state_dict(self) -> dict[str, torch.Tensor]:
        return {name: tensor.clone() for name, tensor in self.state_tensors().items()}

    def load_state_dict(self, state: Mapping[str, torch.Tensor]) -> None:
        for name, tensor in self.state_tensors().items():
            if state[name].shape != tensor.shape:
                raise ValueError(f"{name}: expected shape {tuple(tensor.shape)}, got {tuple(state[name].shape)}")
            tensor.copy_(state[name])


class Tripping(Point):
    """The point; the physics of its last world fails in every iteration."""

    statistic_names = (*Point.statistic_names, "nan_worlds")

    def __init__(self, *arguments: Any, first_world: int = 0, **options: Any) -> None:
        super().__init__(*arguments, first_world=first_world, **options)
        self.statistics = torch.zeros(len(self.statistic_names), dtype=torch.float64)
        self._trips = first_world > 0

    def step(self, actions: torch.Tensor) -> None:
        whole, self.statistics = self.statistics, self.statistics[:-1]
        super().step(actions)
        self.statistics = whole
        self.statistics[-1] += self._trips
        self.failed_world.fill_(self._trips)

    def read_failed_world(self, code: int) -> tuple[int, str] | None:
        return (self.world_count - 1, "it tripped") if code else None


TASK: Any = Point
""":class:`Point` where a task's class is expected: it has the interface without the base."""
