"""Curriculum of levels: a world moves to a harder patch if its robot walked far, to an easier one if it fell short."""

from __future__ import annotations

import warp as wp

from worker.simulation.episodes import STEPS, EpisodeArrays
from worker.simulation.robot_arrays import RobotArrays
from worker.simulation.terrain_arrays import TerrainArrays, terrain_origin
from worker.simulation.worlds import WorldArrays

wp.set_module_options({"enable_backward": False})


@wp.func
def moved_level(terrain: TerrainArrays, world: int, change: int, stream: wp.uint32):
    """Move a world by ``change`` levels: not below the first; beyond the last to a random one, so that no level is forgotten."""
    levels = terrain.origins.shape[0]
    level = terrain.levels[world] + change
    if level >= levels:
        level = wp.randi(stream, 0, levels)
    terrain.levels[world] = wp.max(level, 0)


@wp.func
def walked_levels(
    world: int,
    worlds: WorldArrays,
    robot: RobotArrays,
    terrain: TerrainArrays,
    episodes: EpisodeArrays,
    command: int,
    episode_seconds: float,
    stream: wp.uint32,
):
    """Change a world's level by how far its robot walked in the episode that ends; call it before the world is placed afresh.

    One level up where the robot is farther from its origin than half a patch; else one down where it is less far than half of what
    the commanded velocity would have led it to in a whole episode. It is the rule ``terrain_levels_vel`` of Isaac Lab and mjlab.
    A world that has not lived a step stays where it is.

    Args:
        world: Row.
        worlds: Where the robot is.
        robot: Of which the root moves freely.
        terrain: Whose ``levels`` change.
        episodes: The episode's clock, and the command in its memory.
        command: First column of the commanded velocity along x and y [m/s] in ``episodes.memory``.
        episode_seconds: Length of a whole episode [s].
        stream: A fresh generator.
    """
    if episodes.sums[world, STEPS] == 0.0:
        return
    origin = terrain_origin(terrain, world)
    x = worlds.joint_q[world, robot.root_coordinate] - origin[0]
    y = worlds.joint_q[world, robot.root_coordinate + 1] - origin[1]
    walked = wp.sqrt(x * x + y * y)
    speed = wp.length(wp.vec2(episodes.memory[world, command], episodes.memory[world, command + 1]))
    change = int(0)  # noqa: RUF046 (a variable for Warp, not a constant)
    if walked > 0.5 * terrain.size[0]:
        change = 1
    elif walked < 0.5 * speed * episode_seconds:
        change = -1
    moved_level(terrain, world, change, stream)
