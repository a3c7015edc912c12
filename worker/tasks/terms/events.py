"""Events: resets of a world, pushes, and properties drawn once at startup."""

from __future__ import annotations

import warp as wp

from worker.simulation.kinematics import root_origin_velocity, root_turning, set_root_velocity
from worker.simulation.robot_arrays import BodyArrays, RobotArrays
from worker.simulation.sensors.wrench import LASTING_FROM_NOW, WrenchArrays
from worker.simulation.worlds import WorldArrays
from worker.tasks.declare.term_needs import needs
from worker.tasks.terms.composing import composed
from worker.tasks.terms.placing import NONE, between, draw_root, nowhere, place_default, set_joint, within_limits

wp.set_module_options({"enable_backward": False})


@composed(draw_root, origin=nowhere)
def reset_root():
    """Place a free root: its start + offsets drawn evenly from ranges.

    ``x``, ``y``, ``z`` are along the world's axes [m]; ``roll``, ``pitch``, ``yaw`` turn the root about its own axes at the start
    [rad]; ``velocity_x`` and so on are velocities of the frame's origin in the world [m/s], ``turning_x`` and so on angular [rad/s].

    mjlab, Isaac Lab: reset_root_state_uniform.
    """


@composed(place_default, origin=nowhere)
def reset_to_default():
    """Put a robot or object at its declared pose, with its joints at their default positions, all at rest.

    mjlab, Isaac Lab: reset_scene_to_default.
    """


@wp.func
def reset_joints_by_offset(
    world: int,
    worlds: WorldArrays,
    robot: RobotArrays,
    joint: int,
    stream: wp.uint32,
    position: wp.vec2,
    velocity: wp.vec2 = NONE,
    soft_factor: float = 1.0,
):
    """Put a joint at its default + an offset from ``position`` [m, rad], with a velocity from ``velocity`` [m/s, rad/s].

    The position stays within ``soft_factor`` times the joint's range about its middle.

    mjlab, Isaac Lab: reset_joints_by_offset.
    """
    place = within_limits(robot, joint, robot.defaults[joint] + between(stream, 0, position), soft_factor)
    set_joint(worlds, robot, world, joint, place, between(stream, 1, velocity))


@needs(free_root=True)
@wp.func
def push(
    world: int,
    worlds: WorldArrays,
    robot: RobotArrays,
    bodies: BodyArrays,
    stream: wp.uint32,
    velocity_x: wp.vec2 = NONE,
    velocity_y: wp.vec2 = NONE,
    velocity_z: wp.vec2 = NONE,
    turning_x: wp.vec2 = NONE,
    turning_y: wp.vec2 = NONE,
    turning_z: wp.vec2 = NONE,
):
    """Add velocities to a free root at once, drawn evenly: of its frame's origin [m/s] and angular [rad/s], in the world frame.

    mjlab, Isaac Lab: push_by_setting_velocity.
    """
    linear = wp.vec3(between(stream, 0, velocity_x), between(stream, 1, velocity_y), between(stream, 2, velocity_z))
    angular = wp.vec3(between(stream, 3, turning_x), between(stream, 4, turning_y), between(stream, 5, turning_z))
    linear = linear + root_origin_velocity(worlds, robot, bodies, world)
    angular = angular + root_turning(worlds, robot, world)
    set_root_velocity(worlds, robot, bodies, world, linear, angular)


@wp.func
def _draw_wrenches(world: int, wrench: WrenchArrays, stream: wp.uint32, force: wp.vec2, torque: wp.vec2):
    """Each component of each body's force and torque evenly from its range."""
    for index in range(wrench.bodies.shape[0]):
        first = 6 * index
        wrench.wrenches[world, wrench.bodies[index]] = wp.spatial_vector(
            between(stream, first, force),
            between(stream, first + 1, force),
            between(stream, first + 2, force),
            between(stream, first + 3, torque),
            between(stream, first + 4, torque),
            between(stream, first + 5, torque),
        )


@wp.func
def apply_wrench(world: int, wrench: WrenchArrays, stream: wp.uint32, force: wp.vec2 = NONE, torque: wp.vec2 = NONE):
    """Apply a wrench to each body of an ``ExternalWrench`` until the end of the episode, like wind or a load.

    Each component of the force at its centre of mass [N] and of the torque [N m], in the world frame, is drawn evenly from its range.
    It replaces earlier wrenches.

    mjlab, Isaac Lab: apply_external_force_torque.
    """
    _draw_wrenches(world, wrench, stream, force, torque)
    wrench.left[world] = LASTING_FROM_NOW


@wp.func
def apply_impulse(
    world: int,
    wrench: WrenchArrays,
    stream: wp.uint32,
    duration: wp.vec2,
    force: wp.vec2 = NONE,
    torque: wp.vec2 = NONE,
):
    """Apply a wrench to each body of an ``ExternalWrench`` for a time drawn from ``duration`` [s], like a bump or a gust.

    Each component of the force at its centre of mass [N] and of the torque [N m], in the world frame, is drawn evenly from its range.
    Use it at intervals longer than ``duration``.

    mjlab: apply_body_impulse (whose cooldown_s begins when an impulse is over).
    """
    _draw_wrenches(world, wrench, stream, force, torque)
    wrench.left[world] = wp.max(
        between(stream, 6 * wrench.bodies.shape[0], duration), 1.0e-6
    )  # one control step at least
