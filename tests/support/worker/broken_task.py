"""A cart-pole with a mistake of the kind that users make: an observation that is the root of a negative number, now and then."""

from __future__ import annotations

from typing import ClassVar

import warp as wp

from worker.simulation.episodes import STEP, EpisodeArrays, add_reward, begin_episode, end_step
from worker.simulation.worlds import WorldArrays
from worker.tasks.cartpole import Cartpole, CartpoleParameters, place


@wp.func
def write(observations: wp.array2d(dtype=wp.float32), worlds: WorldArrays, world: int):
    """The third one is NaN where the pole leans by more than 0.2 rad to the left."""
    for column in range(2):
        observations[world, column] = worlds.joint_q[world, column]
        observations[world, 2 + column] = worlds.joint_qd[world, column]
    observations[world, 2] = wp.sqrt(worlds.joint_q[world, 1] + 0.2)


@wp.kernel
def observe(mode: int, max_age: int, parameters: CartpoleParameters, worlds: WorldArrays, episodes: EpisodeArrays):
    """As a user writes it: finite physics is all that it looks at."""
    world = wp.tid()
    restart = mode != STEP
    if mode == STEP:
        angle = worlds.joint_q[world, 1]
        episodes.rewards[world] = 0.0
        add_reward(episodes, world, 0, 1.0)
        restart = end_step(episodes, worlds.overflow, world, wp.abs(angle) > 0.4, True, max_age)
        if restart:
            write(episodes.terminal_observations, worlds, world)
    if restart:
        begin_episode(episodes, world)
        place(parameters, worlds, episodes, world)
    write(episodes.observations, worlds, world)


class Rooted(Cartpole):
    """See the module."""

    observe: ClassVar[wp.Kernel] = observe
