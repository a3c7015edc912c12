"""The ground: heights above it, placement on a terrain's patches, and its levels.

A term with ``scan`` reads a :class:`worker.simulation.sensors.height_scan.HeightScan`; a term with the terrain itself needs a task with
one. A term with a velocity command is 0 unless the command exceeds its ``threshold``, speed [m/s] + turning velocity [rad/s].
"""

from __future__ import annotations

import warp as wp

from worker.simulation.episodes import EpisodeArrays
from worker.simulation.kinematics import quaternion_from_angles, root_position_of, root_rotation_of
from worker.simulation.robot_arrays import BodyArrays, RobotArrays
from worker.simulation.sensors.contact import ContactArrays
from worker.simulation.sensors.frames import FrameArrays
from worker.simulation.sensors.height_scan import HeightScanArrays
from worker.simulation.terrain_arrays import TerrainArrays, ground_height, on_terrain, terrain_origin
from worker.simulation.terrain_levels import walked_levels
from worker.simulation.worlds import WorldArrays
from worker.tasks.declare.term_needs import needs
from worker.tasks.terms.commands import TARGET, command_speed, planar_pose_command, steer_planar_pose_command
from worker.tasks.terms.contacts import planar_speed, swing_error
from worker.tasks.terms.placing import NONE, between, place_root, set_joint
from worker.tasks.terms.root import root_displacement

wp.set_module_options({"enable_backward": False})

_FIRST_STEPS = wp.constant(2)
"""Number of first control steps of an episode in which a robot counts as on its patch, whatever its pose."""


@wp.func
def above_ground(terrain: TerrainArrays, point: wp.vec3) -> float:
    """Height of a point above the ground under it [m]."""
    return point[2] - ground_height(terrain, point[0], point[1])


@wp.func
def scanned_height(world: int, scan: HeightScanArrays, index: int, offset: float = 0.0) -> float:
    """Height of the sensor's frame above the ground at point ``index`` of a scan, minus ``offset`` [m].

    mjlab: height_scan. Isaac Lab: height_scan (whose offset is 0.5 by default).
    """
    return scan.heights[world, index] - offset


@wp.func
def scanned_height_mean(world: int, scan: HeightScanArrays) -> float:
    """Mean height of the sensor's frame above the ground over all points of a scan [m].

    mjlab: -. Isaac Lab: -.
    """
    total = float(0.0)
    for point in range(scan.heights.shape[1]):
        total += scan.heights[world, point]
    return total / float(scan.heights.shape[1])


@wp.func
def scanned_height_error_squared(world: int, scan: HeightScanArrays, target: float) -> float:
    """Square of the mean height above the ground over a scan minus ``target`` [m^2].

    mjlab: -. Isaac Lab: base_height_l2 (with a sensor).
    """
    error = scanned_height_mean(world, scan) - target
    return error * error


@wp.func
def upright_on_ground(world: int, worlds: WorldArrays, robot: RobotArrays, scan: HeightScanArrays, std: float) -> float:
    """exp(-sin(tilt)^2 / std^2), tilt the angle between the root's z axis and the normal of the plane that fits a scan best.

    The plane z = a x + b y + c has the least sum of squares over the scan's points.

    mjlab: upright (with terrain sensors; its plane is nearest to the points by distance from it). Isaac Lab: -.
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
    return wp.exp(-(local[0] * local[0] + local[1] * local[1]) / (std * std))


@wp.func
def height_above_ground(world: int, worlds: WorldArrays, robot: RobotArrays, terrain: TerrainArrays) -> float:
    """Height of the root's origin above the ground under it [m].

    mjlab: -. Isaac Lab: -.
    """
    return above_ground(terrain, root_position_of(worlds, robot, world))


@wp.func
def too_low_above_ground(
    world: int, worlds: WorldArrays, robot: RobotArrays, terrain: TerrainArrays, height: float
) -> bool:
    """Whether the root's origin is less than ``height`` above the ground under it [m].

    mjlab: -. Isaac Lab: -.
    """
    return height_above_ground(world, worlds, robot, terrain) < height


@wp.func
def frame_height_above_ground(world: int, frames: FrameArrays, terrain: TerrainArrays, index: int) -> float:
    """Height of a frame's origin above the ground under it [m], such as of a foot.

    mjlab: foot_height. Isaac Lab: -.
    """
    return above_ground(terrain, frames.positions[world, index])


@wp.func
def foot_clearance_above_ground(
    world: int,
    episodes: EpisodeArrays,
    frames: FrameArrays,
    terrain: TerrainArrays,
    index: int,
    command: int,
    height: float,
    threshold: float = 0.01,
) -> float:
    """|h - height| times the planar speed of a foot [m^2/s], h its height above the ground, while the command asks for more than ``threshold``.

    mjlab: feet_clearance. Isaac Lab: -.
    """
    if command_speed(world, episodes, command) <= threshold:
        return 0.0
    error = above_ground(terrain, frames.positions[world, index]) - height
    return wp.abs(error) * planar_speed(frames, world, index)


@needs(memory_each=1)
@wp.func
def swing_height_error_above_ground(
    world: int,
    episodes: EpisodeArrays,
    contacts: ContactArrays,
    frames: FrameArrays,
    terrain: TerrainArrays,
    index: int,
    command: int,
    memory: int,
    height: float,
    threshold: float = 0.01,
) -> float:
    """At touchdown (p / height - 1)^2, p the greatest height of the foot above the ground in its swing [m], else 0.

    It counts while the command asks for more than ``threshold``.

    mjlab: feet_swing_height. Isaac Lab: -.
    """
    clearance = above_ground(terrain, frames.positions[world, index])
    return swing_error(world, episodes, contacts, index, command, memory, clearance, height, threshold)


@wp.func
def terrain_level(world: int, terrain: TerrainArrays) -> float:
    """Level of the patch on which the world stands, from 0.

    mjlab: terrain_levels_vel (its mean). Isaac Lab: terrain_levels_vel (its mean).
    """
    return float(terrain.levels[world])


@needs(free_root=True)
@wp.func
def reset_root_on_terrain(
    world: int,
    worlds: WorldArrays,
    robot: RobotArrays,
    bodies: BodyArrays,
    terrain: TerrainArrays,
    stream: wp.uint32,
    x: wp.vec2 = NONE,
    y: wp.vec2 = NONE,
    z: wp.vec2 = NONE,
    roll: wp.vec2 = NONE,
    pitch: wp.vec2 = NONE,
    yaw: wp.vec2 = NONE,
    velocity_x: wp.vec2 = NONE,
    velocity_y: wp.vec2 = NONE,
    velocity_z: wp.vec2 = NONE,
    turning_x: wp.vec2 = NONE,
    turning_y: wp.vec2 = NONE,
    turning_z: wp.vec2 = NONE,
):
    """Place a free root as :func:`reset_root`, on the world's patch: its start counts from the patch's origin.

    mjlab: reset_root_state_uniform. Isaac Lab: reset_root_state_uniform.
    """
    offset = wp.vec3(between(stream, 0, x), between(stream, 1, y), between(stream, 2, z))
    turn = quaternion_from_angles(between(stream, 3, roll), between(stream, 4, pitch), between(stream, 5, yaw))
    linear = wp.vec3(between(stream, 6, velocity_x), between(stream, 7, velocity_y), between(stream, 8, velocity_z))
    angular = wp.vec3(between(stream, 9, turning_x), between(stream, 10, turning_y), between(stream, 11, turning_z))
    place_root(world, worlds, robot, bodies, terrain_origin(terrain, world), offset, turn, linear, angular)


@wp.func
def reset_to_default_on_terrain(
    world: int, worlds: WorldArrays, robot: RobotArrays, bodies: BodyArrays, terrain: TerrainArrays
):
    """As :func:`reset_to_default`, on the world's patch: the place of a free root counts from the patch's origin.

    mjlab: -. Isaac Lab: reset_scene_to_default.
    """
    nothing = wp.vec3(0.0, 0.0, 0.0)
    origin = terrain_origin(terrain, world)
    place_root(world, worlds, robot, bodies, origin, nothing, wp.quat_identity(), nothing, nothing)
    for joint in range(robot.coordinates.shape[0]):
        set_joint(worlds, robot, world, joint, robot.defaults[joint], 0.0)


@wp.func
def root_displacement_on_terrain(
    world: int, worlds: WorldArrays, robot: RobotArrays, terrain: TerrainArrays
) -> wp.vec3:
    """As :func:`root_displacement`, where the place at the start counts from the origin of the world's patch [m].

    mjlab: -. Isaac Lab: -.
    """
    return root_displacement(world, worlds, robot) - terrain_origin(terrain, world)


@wp.func
def root_too_far_on_terrain(
    world: int, worlds: WorldArrays, robot: RobotArrays, terrain: TerrainArrays, distance: float
) -> bool:
    """As :func:`root_too_far`, where the place at the start counts from the origin of the world's patch [m].

    mjlab: -. Isaac Lab: -.
    """
    way = root_displacement_on_terrain(world, worlds, robot, terrain)
    return wp.length(wp.vec2(way[0], way[1])) > distance


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

    mjlab: -. Isaac Lab: UniformPose2dCommand.
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

    mjlab: randomize_terrain. Isaac Lab: -.
    """
    number = wp.randi(stream, 0, terrain.origins.shape[0] * terrain.origins.shape[1])
    terrain.levels[world] = number // terrain.origins.shape[1]
    terrain.kinds[world] = number % terrain.origins.shape[1]


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

    mjlab: terrain_levels_vel. Isaac Lab: terrain_levels_vel.
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

    mjlab: terrain_edge_reached. Isaac Lab: -.
    """
    way = root_position_of(worlds, robot, world) - terrain_origin(terrain, world)
    beyond = wp.abs(way[0]) > 0.5 * share * terrain.size[0] or wp.abs(way[1]) > 0.5 * share * terrain.size[1]
    return beyond and episodes.ages[world] >= _FIRST_STEPS
