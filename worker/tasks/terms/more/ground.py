"""The ground: further heights above it, placements on a terrain's patches, and limits."""

from __future__ import annotations

import warp as wp

from worker.simulation.episodes import EpisodeArrays
from worker.simulation.kinematics import root_position_of, root_rotation_of
from worker.simulation.robot_arrays import RobotArrays
from worker.simulation.sensors.frames import FrameArrays
from worker.simulation.sensors.height_scan import HeightScanArrays
from worker.simulation.terrain_arrays import TerrainArrays, ground_height, terrain_origin
from worker.simulation.worlds import WorldArrays
from worker.tasks.declare.term_needs import needs
from worker.tasks.terms.composing import (
    above,
    below,
    composed,
    difference,
    likeness,
    planar_length,
    planar_squared,
    squared,
)
from worker.tasks.terms.feet import clearance_error, swing_error
from worker.tasks.terms.more.commands import TARGET, planar_pose_command, steer_planar_pose_command
from worker.tasks.terms.more.root import root_displacement
from worker.tasks.terms.placing import place_default

wp.set_module_options({"enable_backward": False})


_FIRST_STEPS = wp.constant(2)
"""Number of first control steps of an episode in which a robot counts as on its patch, whatever its pose."""


@wp.func
def above_ground(terrain: TerrainArrays, point: wp.vec3) -> float:
    """Height of a point above the ground under it [m]."""
    return point[2] - ground_height(terrain, point[0], point[1])


@wp.func
def scanned_height_mean(world: int, scan: HeightScanArrays) -> float:
    """Mean height of the sensor's frame above the ground over all points of a scan [m]."""
    total = float(0.0)
    for point in range(scan.heights.shape[1]):
        total += scan.heights[world, point]
    return total / float(scan.heights.shape[1])


@composed(squared, difference, scanned_height_mean)
def scanned_height_error_squared(target: float):
    """Square of the mean height above the ground over a scan minus ``target`` [m^2].

    Isaac Lab: base_height_l2 (with a sensor).
    """


@wp.func
def upright_on_ground(world: int, worlds: WorldArrays, robot: RobotArrays, scan: HeightScanArrays, std: float) -> float:
    """exp(-sin(tilt)^2 / std^2), tilt the angle between the root's z axis and the normal of the plane that fits a scan best.

    The plane z = a x + b y + c has the least sum of squares over the scan's points.

    mjlab: upright (with terrain sensors; its plane is nearest to the points by distance from it).
    """
    count = float(scan.points.shape[1])
    middle = wp.vec3(0.0, 0.0, 0.0)
    for point in range(scan.points.shape[1]):
        middle = middle + scan.points[world, point] / count
    xx = float(0.0)
    xy = float(0.0)
    yy = float(0.0)
    xz = float(0.0)
    yz = float(0.0)
    for point in range(scan.points.shape[1]):
        way = scan.points[world, point] - middle
        xx += way[0] * way[0]
        xy += way[0] * way[1]
        yy += way[1] * way[1]
        xz += way[0] * way[2]
        yz += way[1] * way[2]
    determinant = xx * yy - xy * xy
    normal = wp.vec3(0.0, 0.0, 1.0)
    if determinant > 1.0e-9:  # else all points are on a line, and any plane through it fits
        along_x = (xz * yy - yz * xy) / determinant
        along_y = (yz * xx - xz * xy) / determinant
        normal = wp.normalize(wp.vec3(-along_x, -along_y, 1.0))
    local = wp.quat_rotate_inv(root_rotation_of(worlds, robot, world), normal)
    return likeness(planar_squared(local), std)


@wp.func
def height_above_ground(world: int, worlds: WorldArrays, robot: RobotArrays, terrain: TerrainArrays) -> float:
    """Height of the root's origin above the ground under it [m]."""
    return above_ground(terrain, root_position_of(worlds, robot, world))


@composed(below, height_above_ground)
def too_low_above_ground(height: float):
    """Whether the root's origin is less than ``height`` above the ground under it [m]."""


@wp.func
def frame_height_above_ground(world: int, frames: FrameArrays, terrain: TerrainArrays, index: int) -> float:
    """Height of a frame's origin above the ground under it [m], such as of a foot. mjlab: foot_height (on a terrain)."""
    return above_ground(terrain, frames.positions[world, index])


@composed(clearance_error, clearance=frame_height_above_ground)
def foot_clearance_above_ground():
    """|h - height| times the planar speed of a foot [m^2/s], h its height above the ground, while the command asks for more than ``threshold``.

    mjlab: feet_clearance (on a terrain).
    """


@composed(swing_error, clearance=frame_height_above_ground)
def swing_height_error_above_ground():
    """At touchdown (p / height - 1)^2, p the greatest height of the foot above the ground in its swing [m], else 0.

    It counts while the command asks for more than ``threshold``.

    mjlab: feet_swing_height (on a terrain).
    """


@composed(place_default, origin=terrain_origin)
def reset_to_default_on_terrain():
    """As :func:`reset_to_default`, on the world's patch: the place of a free root counts from the patch's origin.

    Isaac Lab: reset_scene_to_default (on a terrain).
    """


@wp.func
def root_displacement_on_terrain(
    world: int, worlds: WorldArrays, robot: RobotArrays, terrain: TerrainArrays
) -> wp.vec3:
    """As :func:`root_displacement`, where the place at the start counts from the origin of the world's patch [m]."""
    return root_displacement(world, worlds, robot) - terrain_origin(terrain, world)


@composed(above, planar_length, root_displacement_on_terrain)
def root_too_far_on_terrain(distance: float):
    """As :func:`root_too_far`, where the place at the start counts from the origin of the world's patch [m]."""


@needs(command=3, hidden=3)
@wp.func
def planar_pose_command_on_terrain(
    world: int,
    worlds: WorldArrays,
    episodes: EpisodeArrays,
    robot: RobotArrays,
    terrain: TerrainArrays,
    command: int,
    stream: wp.uint32,
    x: wp.vec2,
    y: wp.vec2,
    heading: wp.vec2,
):
    """As :func:`planar_pose_command`, around the robot's start on the world's patch [m]; its update is the same.

    Isaac Lab: UniformPose2dCommand (on a terrain).
    """
    planar_pose_command(world, worlds, episodes, robot, command, stream, x, y, heading)
    origin = terrain_origin(terrain, world)
    for axis in range(2):
        column = command + TARGET + axis
        episodes.memory[world, column] = episodes.memory[world, column] + origin[axis]
    steer_planar_pose_command(world, worlds, episodes, robot, command)


@wp.func
def draw_patch(world: int, terrain: TerrainArrays, stream: wp.uint32):
    """Put a world on a random patch of the terrain, all equally likely; place its robot after that.

    mjlab: randomize_terrain.
    """
    number = wp.randi(stream, 0, terrain.origins.shape[0] * terrain.origins.shape[1])
    terrain.levels[world] = number // terrain.origins.shape[1]
    terrain.kinds[world] = number % terrain.origins.shape[1]


@wp.func
def left_patch(
    world: int,
    worlds: WorldArrays,
    episodes: EpisodeArrays,
    robot: RobotArrays,
    terrain: TerrainArrays,
    share: float = 0.95,
) -> bool:
    """Whether the root is farther from its patch's origin, along x or y, than ``share`` times half of the patch; not in its first two steps.

    mjlab: terrain_edge_reached.
    """
    way = root_position_of(worlds, robot, world) - terrain_origin(terrain, world)
    beyond = wp.abs(way[0]) > 0.5 * share * terrain.size[0] or wp.abs(way[1]) > 0.5 * share * terrain.size[1]
    return beyond and episodes.ages[world] >= _FIRST_STEPS
