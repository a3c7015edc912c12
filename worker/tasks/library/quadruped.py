"""A quadruped, which follows velocity commands on flat ground: forward, sideways and turning."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import warp as wp

from worker.settings.quadruped import QuadrupedConfig
from worker.simulation.episodes import clear_row
from worker.simulation.kinematics import root_rotation_of
from worker.simulation.robot import Robot
from worker.simulation.robot_arrays import RobotArrays
from worker.simulation.worlds import WorldArrays
from worker.tasks import terms
from worker.tasks.declare.declaration import (
    Action,
    Command,
    Declaration,
    Event,
    Metric,
    Observation,
    Reward,
    Termination,
)
from worker.tasks.run.task import Task

wp.set_module_options({"enable_backward": False})

TRUNK = (0.19, 0.09, 0.055)
"""Half the trunk's length, width and height [m], as in ``quadruped.xml``."""


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
    """Stand the robot at the origin facing +x, joints near their standing angles, everything slightly in motion."""
    clear_row(worlds.joint_q, world)
    worlds.joint_q[world, robot.root_coordinate + 2] = height
    worlds.joint_q[world, robot.root_coordinate + 6] = 1.0
    for dof in range(worlds.joint_qd.shape[1]):
        worlds.joint_qd[world, dof] = velocity * wp.randf(stream, -1.0, 1.0)
    for joint in range(robot.coordinates.shape[0]):
        position = robot.defaults[joint] + angle * wp.randf(stream, -1.0, 1.0)
        worlds.joint_q[world, robot.coordinates[joint]] = position


@wp.func
def trunk_down(world: int, worlds: WorldArrays, robot: RobotArrays, half: wp.vec3) -> bool:
    """Whether the lowest corner of a box with these half sizes [m] touches the ground."""
    up = wp.quat_rotate_inv(root_rotation_of(worlds, robot, world), wp.vec3(0.0, 0.0, 1.0))
    below = wp.abs(up[0]) * half[0] + wp.abs(up[1]) * half[1] + wp.abs(up[2]) * half[2]
    return worlds.joint_q[world, robot.root_coordinate + 2] < below


@wp.func
def vertical_velocity_squared(world: int, worlds: WorldArrays, robot: RobotArrays) -> float:
    """Square of the velocity of the trunk's centre of mass along its own upward axis [m^2/s^2]."""
    velocity = terms.root_com_linear_velocity(world, worlds, robot)[2]
    return velocity * velocity


class Quadruped(Task):
    """``quadruped.xml`` beside this file: 48 observations, 12 actions, 50 control steps a second, episodes of 20 s."""

    config_type = QuadrupedConfig
    ground = True
    solver_options = {
        # The worst case: eight corners and eight spheres with a contact of four rows each, and twelve joint limits. In 96
        # worlds x 300 steps of random, zero and held random actions there were at most 16 contacts and 26 rows.
        "nconmax": 16,
        "njmax": 76,
        "iterations": 4,
        "ls_iterations": 8,
        "tolerance": 1.0e-4,
    }

    def robot(self, config: QuadrupedConfig) -> Robot:
        """The robot as it stands; its own parts do not collide with each other."""
        return Robot(
            Path(__file__).with_name("quadruped.xml"),
            position=(0.0, 0.0, config.start_height),
            joint_positions={"*_hip": config.stand_hip, "*_thigh": config.stand_thigh, "*_knee": config.stand_knee},
            self_collisions=False,
        )

    def declare(self, config: QuadrupedConfig) -> Declaration:
        """The terms; each but the fall is one per second."""

        def rate(function: wp.Function, **options: Any) -> Reward:
            return Reward(function, per_second=True, **options)

        return Declaration(
            actions={"target": Action(terms.position_target, scale=config.action_scale, offset="default", unit="rad")},
            observations={
                "trunk_velocity": Observation(terms.root_com_linear_velocity, unit="m/s"),
                "trunk_angular_velocity": Observation(terms.root_angular_velocity, unit="rad/s"),
                "gravity": Observation(terms.projected_gravity),
                "command": Observation(terms.command_vector, names=("command_forward", "command_left", "command_turn")),
                "position": Observation(terms.joint_position, offset="default", unit="rad"),
                "velocity": Observation(terms.joint_velocity, scale=config.velocity_scale, unit="rad/s"),
                "previous_action": Observation(terms.clipped_last_action),
            },
            rewards={
                "track_linear": rate(terms.track_planar_velocity, std=0.5),
                "track_angular": rate(terms.track_turning_velocity, std=0.5),
                "lin_vel_z": rate(vertical_velocity_squared),
                "ang_vel_xy": rate(terms.tipping_rate_squared),
                "orientation": rate(terms.tilt_squared),
                "torques": rate(terms.joint_effort_squared),
                # of the unclipped action: beyond the limits nothing else would keep it from drifting away
                "action_rate": rate(terms.action_rate_squared),
                "pose": rate(terms.joint_deviation_squared),
                "limits": rate(terms.joint_limit_excess, soft_factor=0.9),
                "fall": Reward(terms.ended),
            },
            terminations={
                "trunk_down": Termination(trunk_down, half=TRUNK),
                "tilted": Termination(terms.root_tilted, limit=config.tilt_limit),
            },
            metrics={
                "error_vel_xy": Metric(terms.planar_velocity_error),
                "error_vel_yaw": Metric(terms.turning_velocity_error),
            },
            commands={
                "velocity": Command(
                    terms.velocity_command,
                    names=("forward", "left", "turn"),
                    units=("m/s", "m/s", "rad/s"),
                    seconds=config.command_seconds,
                    forward=config.command_forward,
                    left=config.command_left,
                    turn=config.command_turn,
                    standing_share=config.command_stand,
                    grows=True,
                )
            },
            events={
                "place": Event(
                    place,
                    height=config.start_height,
                    angle=config.start_angle_noise,
                    velocity=config.start_velocity_noise,
                )
            },
        )
