"""A cart-pole with a mistake of the kind that users make: an observation that is the root of a negative number, now and then."""

from __future__ import annotations

import dataclasses

import warp as wp

from worker.tasks import Declaration, Observation, RobotArrays, WorldArrays, terms
from worker.tasks.cartpole import Cartpole
from worker.tasks.configs.cartpole import CartpoleConfig


@wp.func
def root(world: int, worlds: WorldArrays, robot: RobotArrays) -> float:
    """NaN where the pole leans by more than 0.2 rad to the left."""
    return wp.sqrt(worlds.joint_q[world, robot.coordinates[1]] + 0.2)


class Rooted(Cartpole):
    """See the module."""

    def declare(self, config: CartpoleConfig) -> Declaration:
        observations = {
            "position": Observation(terms.joint_position),
            "root": Observation(root, names=("slider_velocity",)),
            "velocity": Observation(terms.joint_velocity, joints="hinge"),
        }
        return dataclasses.replace(super().declare(config), observations=observations)
