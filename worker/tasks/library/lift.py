"""An arm that grips a cube and lifts it to a target, as in mjlab 1.6 (``Mjlab-Lift-Cube-Yam``)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from worker.settings.lift import LiftCubeConfig
from worker.simulation.objects import Box
from worker.simulation.robot import Robot
from worker.simulation.sensors.contact import ContactSensor
from worker.simulation.sensors.frames import Frames
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
from worker.tasks.library.robots.mjlab import friction
from worker.tasks.library.robots.yam import ACTION_SCALE, FINGERTIPS, GRASP, GRIPPER, yam
from worker.tasks.run.task import Task

EDGE = 0.04
"""Length of the cube's edges [m]."""


class LiftCube(Task):
    """The YAM arm and a cube: 29 observations, 7 actions, 50 control steps a second, episodes of 20 s."""

    config_type = LiftCubeConfig
    ground = True
    solver_options = {
        "integrator": "implicitfast",
        "cone": "elliptic",
        "impratio": 10.0,
        "iterations": 10,
        "ls_iterations": 20,
        "tolerance": 1.0e-8,
        "ls_tolerance": 0.01,
        "nconmax": 55,
        "njmax": 600,
    }

    def robot(self, config: LiftCubeConfig) -> Robot:
        """The arm, its gripper half open."""
        return yam()

    def objects(self, config: Any) -> Mapping[str, Any]:
        """The cube; the command places it."""
        return {
            "cube": Box("cube", size=(EDGE, EDGE, EDGE), mass=0.05, position=(0.3, 0.0, EDGE), color=(0.8, 0.2, 0.2))
        }

    def declare(self, config: LiftCubeConfig) -> Declaration:
        """The terms, by mjlab's names; each reward is per second."""

        def rate(function: Any, **options: Any) -> Reward:
            return Reward(function, per_second=True, **options)

        turns, slides = ["rad"] * 6, ["m"] * 2  # the arm, then the fingers
        return Declaration(
            sensors={
                "hand": Frames(sites=GRASP),
                "ground": ContactSensor(bodies=GRIPPER, against="ground", fine=True, together=True),
            },
            actions={
                "joint_pos": Action(
                    terms.position_target,
                    joints=tuple(ACTION_SCALE),
                    scale=ACTION_SCALE,
                    offset="default",
                    clip=None,
                )
            },
            observations={
                "joint_pos": Observation(terms.joint_position, offset="default", noise=0.01, unit=turns + slides),
                "joint_vel": Observation(
                    terms.joint_velocity, noise=1.5, unit=[f"{unit}/s" for unit in turns + slides]
                ),
                "ee_to_cube": Observation(terms.hand_to_object, other="cube", hand="hand", noise=0.01, unit="m"),
                "cube_to_goal": Observation(
                    terms.object_to_target, other="cube", noise=0.01, unit="m", kind="measured"
                ),
                "actions": Observation(terms.last_action),
            },
            rewards={
                "lift": rate(
                    terms.reach_and_bring_object, robot="cube", hand="hand", reaching_std=0.2, bringing_std=0.3
                ),
                "lift_precise": rate(terms.bring_object, robot="cube", std=0.05),
                "action_rate_l2": rate(terms.action_rate_squared),
                "joint_pos_limits": rate(terms.joint_limit_excess, soft_factor=0.9),
                "joint_vel_hinge": rate(terms.joint_velocity_excess_squared, limit=0.5),
            },
            metrics={
                "object_height": Metric(terms.root_height, robot="cube"),
                "position_error": Metric(terms.object_target_distance, robot="cube"),
                "at_goal": Metric(terms.object_at_target, robot="cube", distance=0.05),
                "episode_success": Metric(terms.object_was_at_target, robot="cube", memory=1, distance=0.05),
            },
            success="episode_success",  # the cube was at a target: in an episode's last step a new target may be seconds old
            terminations={
                "ee_ground_collision": Termination(terms.illegal_contact, contacts="ground", force=config.ground_force)
            },
            commands={
                "lift_height": Command(
                    terms.lift_command,
                    robot="cube",
                    names=("target_x", "target_y", "target_z"),
                    units=("m", "m", "m"),
                    ranges={"target_x": config.target_x, "target_y": config.target_y, "target_z": config.target_z},
                    seconds=config.command_seconds,
                    x=config.target_x,
                    y=config.target_y,
                    z=config.target_z,
                    object_x=config.cube_x,
                    object_y=config.cube_y,
                    object_z=config.cube_z,
                    object_yaw=config.cube_yaw,
                )
            },
            events={"reset_robot": Event(terms.reset_to_default)},
            randomize=friction("fingertip_friction", FINGERTIPS, shared=False),
        )
