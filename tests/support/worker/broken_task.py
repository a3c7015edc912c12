"""Cart-poles with a mistake of the kind that users make: a term that is the root of a negative number, now and then."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import torch
import warp as wp

from worker.settings.cartpole import CartpoleConfig
from worker.settings.task import reward_weights
from worker.tasks import Declaration, Observation, Reward, RobotArrays, WorldArrays, terms
from worker.tasks.library.cartpole import Cartpole


@wp.func
def root(world: int, worlds: WorldArrays, robot: RobotArrays) -> float:
    """NaN where the pole leans by more than 0.2 rad to the left."""
    return wp.sqrt(worlds.joint_q[world, robot.coordinates[1]] + 0.2)


def root_in_torch(task: Cartpole) -> torch.Tensor:
    """The same, in torch."""
    angles: torch.Tensor = wp.to_torch(task.worlds.arrays.joint_q)[:, 1]
    return torch.sqrt(angles + 0.2)


class Rooted(Cartpole):
    """Its third observation is such a term."""

    def declare(self, config: CartpoleConfig) -> Declaration:
        observations = {
            "position": Observation(terms.joint_position),
            "root": Observation(root, names=("slider_velocity",)),
            "velocity": Observation(terms.joint_velocity, joints="hinge"),
        }
        return dataclasses.replace(super().declare(config), observations=observations)


class RootedCritic(Cartpole):
    """So is a privileged observation, which the critic alone has."""

    def declare(self, config: CartpoleConfig) -> Declaration:
        whole = super().declare(config)
        critic = {"position": Observation(terms.joint_position), "root": Observation(root)}
        return dataclasses.replace(whole, observations={"policy": whole.groups["policy"], "critic": critic})


@dataclasses.dataclass(frozen=True)
class RottenConfig(CartpoleConfig):
    """With a weight for the term."""

    rewards: Mapping[str, float] = reward_weights(alive=1.0, rotten=0.5, fall=-2.0)


class Rotten(Cartpole):
    """So is its second reward term."""

    config_type = RottenConfig
    rotten: Any = root

    def declare(self, config: CartpoleConfig) -> Declaration:
        whole = super().declare(config)
        rewards = {"alive": Reward(terms.alive), "rotten": Reward(self.rotten), "fall": Reward(terms.ended)}
        return dataclasses.replace(whole, rewards=rewards)


class RottenInTorch(Rotten):
    """So is its second reward term, which is written in torch."""

    rotten = staticmethod(root_in_torch)
