"""Commands: draws, updates in every step, and observations of them.

A drawing function is called when an episode begins and when the command's time is up. It writes the numbers into ``episodes.memory`` from
the column ``command`` on. A steering function is the command's ``update``, called in every step.
"""

from __future__ import annotations

import warp as wp

from worker.simulation.episodes import EpisodeArrays
from worker.simulation.kinematics import quaternion_from_angles, root_rotation_of, set_root_pose, wrapped_angle, yaw_of
from worker.simulation.robot_arrays import RobotArrays
from worker.simulation.worlds import WorldArrays
from worker.tasks.declare.term_needs import needs

wp.set_module_options({"enable_backward": False})


HEADING = wp.constant(3)
FOLLOWS_HEADING = wp.constant(4)
STANDS = wp.constant(5)
IN_WORLD = wp.constant(6)
WORLD_VELOCITY = wp.constant(7)
"""Hidden columns of :func:`heading_velocity_command`, counted from the command's first; the last is the first of two."""


@needs(command=3)
@wp.func
def velocity_command(
    world: int,
    episodes: EpisodeArrays,
    command: int,
    stream: wp.uint32,
    forward: wp.vec2,
    left: wp.vec2,
    turn: wp.vec2,
    standing_share: float = 0.0,
    turning_share: float = 0.0,
    forward_share: float = 0.0,
    least_forward: float = 0.3,
    grows: bool = False,
):
    """Draw velocities forward, to the left [m/s] and turning left [rad/s], each evenly from its range; 3 numbers.

    Of all commands ``standing_share`` are to stand still, of the others ``turning_share`` to turn on the spot, of the others
    ``forward_share`` to go straight ahead, with ``least_forward`` [m/s] or more. ``grows``: all are multiplied by the task's level.

    mjlab, Isaac Lab: UniformVelocityCommand (without headings).
    """
    velocity = wp.vec3(
        wp.randf(stream, forward[0], forward[1]), wp.randf(stream, left[0], left[1]), wp.randf(stream, turn[0], turn[1])
    )
    stands = wp.randf(stream) < standing_share
    turns = wp.randf(stream) < turning_share
    ahead = wp.randf(stream) < forward_share
    if stands:
        velocity = wp.vec3(0.0, 0.0, 0.0)
    elif turns:
        velocity = wp.vec3(0.0, 0.0, velocity[2])
    elif ahead:
        velocity = wp.vec3(wp.max(wp.abs(velocity[0]), least_forward), 0.0, 0.0)
    if grows:
        velocity = episodes.level[0] * velocity
    for axis in range(3):
        episodes.memory[world, command + axis] = velocity[axis]


@needs(command=3, hidden=6)
@wp.func
def heading_velocity_command(
    world: int,
    episodes: EpisodeArrays,
    command: int,
    stream: wp.uint32,
    forward: wp.vec2,
    left: wp.vec2,
    turn: wp.vec2,
    heading: wp.vec2,
    standing_share: float = 0.0,
    heading_share: float = 1.0,
    world_share: float = 0.0,
    forward_share: float = 0.0,
    least_forward: float = 0.3,
):
    """Draw velocities as :func:`velocity_command`, and a heading in the world [rad]; 3 numbers and 6 hidden ones.

    Declare it with ``update=Term(terms.steer_velocity_command, ...)``, which turns the robot to its heading in ``heading_share`` of all
    commands, and keeps the direction fixed in the world in ``world_share``. Standing, these two and going straight ahead are drawn
    independently; standing overrides the others.

    mjlab, Isaac Lab: UniformVelocityCommand.
    """
    velocity = wp.vec3(
        wp.randf(stream, forward[0], forward[1]), wp.randf(stream, left[0], left[1]), wp.randf(stream, turn[0], turn[1])
    )
    episodes.memory[world, command + HEADING] = wp.randf(stream, heading[0], heading[1])
    episodes.memory[world, command + FOLLOWS_HEADING] = wp.where(wp.randf(stream) < heading_share, 1.0, 0.0)
    episodes.memory[world, command + IN_WORLD] = wp.where(wp.randf(stream) < world_share, 1.0, 0.0)
    stands = wp.randf(stream) < standing_share
    episodes.memory[world, command + STANDS] = wp.where(stands, 1.0, 0.0)
    episodes.memory[world, command + WORLD_VELOCITY] = velocity[0]
    episodes.memory[world, command + WORLD_VELOCITY + 1] = velocity[1]
    if wp.randf(stream) < forward_share:
        velocity = wp.vec3(wp.max(wp.abs(velocity[0]), least_forward), 0.0, 0.0)
    if stands:
        velocity = wp.vec3(0.0, 0.0, 0.0)
    for axis in range(3):
        episodes.memory[world, command + axis] = velocity[axis]


@needs(command=3, hidden=6)
@wp.func
def steer_velocity_command(
    world: int,
    worlds: WorldArrays,
    episodes: EpisodeArrays,
    robot: RobotArrays,
    command: int,
    turn: wp.vec2,
    stiffness: float = 1.0,
):
    """Turn a robot to the heading of :func:`heading_velocity_command`: stiffness * (heading - yaw), clipped to ``turn`` [rad/s].

    Commands in the world's frame are turned into the robot's present frame; commands to stand stay 0. ``stiffness`` is in 1/s.

    mjlab, Isaac Lab: UniformVelocityCommand (heading_control_stiffness).
    """
    if episodes.memory[world, command + STANDS] > 0.0:
        for axis in range(3):
            episodes.memory[world, command + axis] = 0.0
        return
    yaw = yaw_of(root_rotation_of(worlds, robot, world))
    if episodes.memory[world, command + FOLLOWS_HEADING] > 0.0:
        error = wrapped_angle(episodes.memory[world, command + HEADING] - yaw)
        episodes.memory[world, command + 2] = wp.clamp(stiffness * error, turn[0], turn[1])
    if episodes.memory[world, command + IN_WORLD] > 0.0:
        along_x = episodes.memory[world, command + WORLD_VELOCITY]
        along_y = episodes.memory[world, command + WORLD_VELOCITY + 1]
        episodes.memory[world, command] = wp.cos(yaw) * along_x + wp.sin(yaw) * along_y
        episodes.memory[world, command + 1] = wp.cos(yaw) * along_y - wp.sin(yaw) * along_x


@needs(command=3)
@wp.func
def lift_command(
    world: int,
    worlds: WorldArrays,
    episodes: EpisodeArrays,
    robot: RobotArrays,
    command: int,
    stream: wp.uint32,
    x: wp.vec2,
    y: wp.vec2,
    z: wp.vec2,
    object_x: wp.vec2,
    object_y: wp.vec2,
    object_z: wp.vec2,
    object_yaw: wp.vec2,
):
    """Draw a target in the world frame [m], and place the object at rest elsewhere [m, rad]; 3 numbers.

    ``robot=`` names the object, whose root is free; its ranges are in the world frame.

    mjlab: LiftingCommand. Isaac Lab: UniformPoseCommand (with reset_root_state_uniform of the object).
    """
    episodes.memory[world, command] = wp.randf(stream, x[0], x[1])
    episodes.memory[world, command + 1] = wp.randf(stream, y[0], y[1])
    episodes.memory[world, command + 2] = wp.randf(stream, z[0], z[1])
    position = wp.vec3(
        wp.randf(stream, object_x[0], object_x[1]),
        wp.randf(stream, object_y[0], object_y[1]),
        wp.randf(stream, object_z[0], object_z[1]),
    )
    rotation = quaternion_from_angles(0.0, 0.0, wp.randf(stream, object_yaw[0], object_yaw[1]))
    set_root_pose(worlds, robot, world, wp.transform(position, rotation))
    for axis in range(6):
        worlds.joint_qd[world, robot.root_dof + axis] = 0.0


@needs(command=3)
@wp.func
def command_vector(world: int, episodes: EpisodeArrays, command: int) -> wp.vec3:
    """The first three numbers of a command, such as velocities or a position [unit of the command].

    mjlab, Isaac Lab: generated_commands (its first three numbers).
    """
    return wp.vec3(
        episodes.memory[world, command], episodes.memory[world, command + 1], episodes.memory[world, command + 2]
    )


@needs(command=3)
@wp.func
def command_speed(world: int, episodes: EpisodeArrays, command: int) -> float:
    """Magnitude of a velocity command: speed [m/s] + magnitude of the turning velocity [rad/s].

    mjlab: total_command (inside of its rewards).
    """
    commanded = command_vector(world, episodes, command)
    return wp.length(wp.vec2(commanded[0], commanded[1])) + wp.abs(commanded[2])
