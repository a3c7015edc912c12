"""Running along +x: robots with a torso and hinges, with the observations and rewards known from Isaac Gym's Ant and Humanoid."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import warp as wp

from worker.settings.running import RunningConfig
from worker.simulation.episodes import EpisodeArrays, clear_row, clipped_action
from worker.simulation.kinematics import root_rotation_of
from worker.simulation.robot import Robot
from worker.simulation.robot_arrays import RobotArrays
from worker.simulation.worlds import WorldArrays
from worker.tasks import terms
from worker.tasks.declare.declaration import Action, Declaration, Event, Observation, Reward, Termination
from worker.tasks.run.task import Task

wp.set_module_options({"enable_backward": False})


@wp.func
def attitude(world: int, worlds: WorldArrays, robot: RobotArrays) -> wp.vec4:
    """Yaw and roll of the torso [rad], cosines of its up to the vertical and of its forward to +x."""
    rotation = root_rotation_of(worlds, robot, world)
    forward = wp.quat_rotate(rotation, wp.vec3(1.0, 0.0, 0.0))
    left = wp.quat_rotate(rotation, wp.vec3(0.0, 1.0, 0.0))
    up = wp.quat_rotate(rotation, wp.vec3(0.0, 0.0, 1.0))
    return wp.vec4(wp.atan2(forward[1], forward[0]), wp.atan2(left[2], up[2]), up[2], forward[0])


@wp.func
def heading(world: int, worlds: WorldArrays, robot: RobotArrays) -> float:
    """1 where the cosine to +x is above 0.8, in proportion below."""
    rotation = root_rotation_of(worlds, robot, world)
    return wp.min(wp.quat_rotate(rotation, wp.vec3(1.0, 0.0, 0.0))[0] / 0.8, 1.0)


@wp.func
def energy(
    world: int,
    worlds: WorldArrays,
    episodes: EpisodeArrays,
    robot: RobotArrays,
    joint: int,
    scale: float,
    strongest: float,
) -> float:
    """|action x scaled velocity| of a joint x its motor's share of the strongest motor; action and joint have the same number."""
    velocity = worlds.joint_qd[world, robot.dofs[joint]] * scale
    return wp.abs(clipped_action(episodes, world, joint) * velocity) * robot.efforts[joint] / strongest


@wp.func
def limits(world: int, worlds: WorldArrays, robot: RobotArrays, joint: int, strongest: float) -> float:
    """Depth of a joint in the last hundredth at an end of its range, from 0 to 1, x its motor's share of the strongest motor."""
    ends = robot.ranges[joint]
    place = (2.0 * worlds.joint_q[world, robot.coordinates[joint]] - ends[0] - ends[1]) / (ends[1] - ends[0])
    return wp.clamp((wp.abs(place) - 0.98) / 0.02, 0.0, 1.0) * robot.efforts[joint] / strongest


@wp.func
def place(
    world: int,
    worlds: WorldArrays,
    robot: RobotArrays,
    stream: wp.uint32,
    height: float,
    angle: float,
    velocity: float,
):
    """Stand the robot at the origin facing +x, joints near their usual pose and inside their ranges."""
    clear_row(worlds.joint_q, world)
    clear_row(worlds.joint_qd, world)
    worlds.joint_q[world, robot.root_coordinate + 2] = height
    worlds.joint_q[world, robot.root_coordinate + 6] = 1.0
    for joint in range(robot.coordinates.shape[0]):
        ends = robot.ranges[joint]
        position = robot.defaults[joint] + angle * wp.randf(stream, -1.0, 1.0)
        worlds.joint_q[world, robot.coordinates[joint]] = wp.clamp(position, ends[0], ends[1])
        worlds.joint_qd[world, robot.dofs[joint]] = velocity * wp.randf(stream, -1.0, 1.0)


class Running(Task):
    """A robot of one of Newton's bundled MJCF files that runs; a subclass names the file and sets its numbers."""

    ground = True
    asset: ClassVar[str]
    """The file, by its name among Newton's assets: a torso on a free joint, hinges, a motor for each hinge."""
    start_pose: ClassVar[Mapping[str, float]] = {}
    """Angles at the start that are not zero, by joint [rad]."""

    def robot(self, config: RunningConfig) -> Robot:
        """The robot without the file's floor; its own parts do not collide with each other.

        It starts clear of the ground. Some files place it half below, where the solver would need more capacity than it ever does later.
        """
        return Robot(
            f"newton:{self.asset}",
            position=(0.0, 0.0, config.start_height),
            joint_positions={**self.start_pose, "*": 0.0},
            self_collisions=False,
            visuals=False,
            accept=(
                "joint root: stiffness",
            ),  # the humanoid's free joint inherits a spring of its hinges' class, which nobody meant
        )

    def declare(self, config: RunningConfig) -> Declaration:
        """The terms; the step of a fall has no reward except the fall's own."""
        view = self.views["robot"]
        ranges, strongest = view.ranges, max(view.efforts)
        speed = config.velocity_scale
        return Declaration(
            actions={"torque": Action(terms.effort)},
            observations={
                "torso_height": Observation(terms.root_height, unit="m"),
                "torso_velocity": Observation(terms.root_com_linear_velocity, unit="m/s"),
                "torso_angular_velocity": Observation(
                    terms.root_angular_velocity, scale=config.angular_velocity_scale, unit="rad/s"
                ),
                "attitude": Observation(
                    attitude,
                    names=("torso_yaw", "torso_roll", "torso_up", "torso_heading"),
                    unit=("rad", "rad", "1", "1"),
                ),
                "position": Observation(
                    terms.joint_position,
                    offset=[(least + greatest) / 2.0 for least, greatest in ranges],
                    scale=[2.0 / (greatest - least) for least, greatest in ranges],
                    unit="rad",
                ),
                "velocity": Observation(terms.joint_velocity, scale=speed, unit="rad/s"),
                "previous_action": Observation(terms.clipped_last_action),
            },
            rewards={
                "forward": Reward(terms.velocity_towards, direction=(1.0, 0.0, 0.0), unless_terminated=True),
                "heading": Reward(heading, unless_terminated=True),
                "up": Reward(terms.is_upright, threshold=0.93, unless_terminated=True),
                "alive": Reward(terms.alive),
                # of the unclipped action: beyond the motors' limits nothing else would keep it from drifting away
                "action": Reward(terms.action_squared, unless_terminated=True),
                "energy": Reward(energy, scale=speed, strongest=strongest, unless_terminated=True),
                "limits": Reward(limits, strongest=strongest, unless_terminated=True),
                "fall": Reward(terms.ended),
            },
            terminations={"fall": Termination(terms.root_too_low, height=config.fall_height)},
            events={
                "place": Event(
                    place,
                    height=config.start_height,
                    angle=config.start_angle_noise,
                    velocity=config.start_velocity_noise,
                )
            },
        )
