"""The ground: heights above it, placement on a terrain's patches, and its levels.

A term with ``scan`` reads a :class:`worker.simulation.sensors.height_scan.HeightScan`; a term with the terrain itself needs a task with
one. A term with a velocity command is 0 unless the command exceeds its ``threshold``, speed [m/s] + turning velocity [rad/s].
"""

from __future__ import annotations

import warp as wp

from worker.simulation.episodes import EpisodeArrays
from worker.simulation.kinematics import root_position_of
from worker.simulation.robot_arrays import RobotArrays
from worker.simulation.sensors.height_scan import HeightScanArrays
from worker.simulation.terrain_arrays import TerrainArrays, on_terrain, terrain_origin
from worker.simulation.terrain_levels import walked_levels
from worker.simulation.worlds import WorldArrays
from worker.tasks.terms.composing import composed
from worker.tasks.terms.placing import draw_root

wp.set_module_options({"enable_backward": False})


@wp.func
def scanned_height(world: int, scan: HeightScanArrays, index: int, offset: float = 0.0) -> float:
    """Height of the sensor's frame above the ground at point ``index`` of a scan, minus ``offset`` [m].

    mjlab: height_scan. Isaac Lab: height_scan (whose offset is 0.5 by default).
    """
    return scan.heights[world, index] - offset


@wp.func
def terrain_level(world: int, terrain: TerrainArrays) -> float:
    """Level of the patch on which the world stands, from 0. mjlab, Isaac Lab: terrain_levels_vel (its mean)."""
    return float(terrain.levels[world])


@composed(draw_root, origin=terrain_origin)
def reset_root_on_terrain():
    """Place a free root as :func:`reset_root`, on the world's patch: its start counts from the patch's origin.

    mjlab, Isaac Lab: reset_root_state_uniform (on a terrain).
    """


@wp.func
def walk_to_levels(
    world: int,
    worlds: WorldArrays,
    episodes: EpisodeArrays,
    robot: RobotArrays,
    terrain: TerrainArrays,
    command: int,
    stream: wp.uint32,
    episode_seconds: float,
):
    """One level up if the robot walked farther than half a patch, else one down if it walked less than half of the commanded distance.

    ``episode_seconds`` is the length of a whole episode [s]. After the last level comes a random one.

    mjlab, Isaac Lab: terrain_levels_vel.
    """
    walked_levels(world, worlds, robot, terrain, episodes, command, episode_seconds, stream)


@wp.func
def left_terrain(
    world: int, worlds: WorldArrays, robot: RobotArrays, terrain: TerrainArrays, margin: float = 0.0
) -> bool:
    """Whether the root is more than ``margin`` beyond the terrain's patches [m]; a negative margin lies inside them.

    mjlab: out_of_terrain_bounds (margin: the border's width less theirs). Isaac Lab: terrain_out_of_bounds (as mjlab's).
    """
    position = root_position_of(worlds, robot, world)
    return not on_terrain(terrain, position[0], position[1], margin)
