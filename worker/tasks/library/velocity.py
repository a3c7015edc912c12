"""Legged robots that follow velocity commands, on a plane or on rough ground: the common part of mjlab 1.6's velocity tasks.

Source of all numbers: ``mjlab/tasks/velocity/velocity_env_cfg.py`` and ``config/*/env_cfgs.py``.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import newton

from worker.settings.velocity import VelocityConfig, range_at, widest
from worker.simulation.declared_randomization import Randomize
from worker.simulation.robot import Robot
from worker.simulation.sensors.contact import ContactSensor
from worker.simulation.sensors.frames import Frames
from worker.simulation.sensors.height_scan import GridPattern, HeightScan, RingPattern
from worker.simulation.sensors.imu import Imu
from worker.simulation.sensors.momentum import AngularMomentum
from worker.simulation.terrain import Terrain
from worker.tasks import terms
from worker.tasks.declare.declaration import (
    Action,
    Command,
    Curriculum,
    Declaration,
    Event,
    Metric,
    Observation,
    Reward,
    Term,
    Termination,
)
from worker.tasks.run.task import Task

COMMANDED = ("forward", "left", "turn")
"""The commanded velocities; each has stages in the configuration, such as ``command_forward``."""
FARTHEST_SCAN = 5.0
"""Range of the scan of the ground below the trunk [m]; heights are divided by it."""
FOOT_HEIGHT = 0.1
"""Target height of a swinging foot [m]."""
MOVES = 0.05
"""Smaller commands mean standing: speed [m/s] + turning velocity [rad/s]."""
UNSEEN = 0.3
"""Distance to the end of the terrain's border at which an episode ends [m]."""


@dataclass(frozen=True)
class Walker:
    """The properties of a robot that the task needs.

    Attributes:
        robot: Function that makes it.
        action_scale: How far an action of 1 moves a joint's target [rad], by pattern of joints.
        base: Body of the root.
        torso: Body that is to be upright.
        imu: Site of the inertial measurement unit.
        soles: Sites of the feet, in the model's order.
        touching: Geoms or bodies of the feet, in the order of ``soles``.
        ring: Points around a sole at which the ground is scanned.
        tolerances: Tolerated deviations of joints from their default positions.
        randomize: Quantities that differ from world to world.
    """

    robot: Callable[[], Robot]
    action_scale: Mapping[str, float]
    base: str
    torso: str
    imu: str
    soles: Sequence[str]
    touching: ContactSensor
    ring: RingPattern
    tolerances: terms.Tolerances
    randomize: Mapping[str, Randomize]

    @property
    def foot_points(self) -> int:
        """Points of the scan around each foot."""
        return len(self.ring.points())


class Velocity(Task):
    """A robot that follows velocity commands; a subclass names the robot, its ground, and in ``changes`` what else differs."""

    ground = True
    walker: ClassVar[Walker]
    """The robot."""
    rough: ClassVar[bool] = False
    """Whether it walks on rough ground, which it observes, instead of a plane."""

    def robot(self, config: VelocityConfig) -> Robot:
        """The robot in its standing pose."""
        return self.walker.robot()

    def terrain(self, config: VelocityConfig) -> Terrain | None:
        """Stairs, slopes, waves and rough ground, harder with each level; None on flat ground."""
        return Terrain() if self.rough else None

    def build(self, builder: newton.ModelBuilder) -> None:
        """As :meth:`Task.build`; the limits of the solver are those of the configuration.

        Raises:
            ValueError: ``config.numbers`` names a range that the stages of a command set in each iteration.
        """
        config: Any = self.config
        for name in COMMANDED:
            for place in commanded_places(name):
                if place in config.numbers:
                    raise ValueError(
                        f"config.numbers: the stages of command_{name} set {place} before every iteration; use command_{name}"
                    )
        super().build(builder)
        limits = {"iterations": config.solver_iterations, "ls_iterations": config.solver_line_search}
        self.solver_options = {**type(self).solver_options, **limits}

    def begin_iteration(self, iteration: int, reward: float | None, episode_length: float | None) -> None:
        """Set this iteration's ranges of commands, then apply ``config.curriculum``."""
        config: Any = self.config
        for name in COMMANDED:
            ends = range_at(getattr(config, f"command_{name}"), iteration)
            for place in commanded_places(name):
                for index, end in enumerate(ends):
                    self.numbers(place)[index].fill_(end)
        super().begin_iteration(iteration, reward, episode_length)

    def declare(self, config: VelocityConfig) -> Declaration:
        """The terms that all robots share; ``changes`` has those of one."""
        return Declaration(
            actions={
                "joint_pos": Action(
                    terms.position_target,
                    scale=self.walker.action_scale,
                    offset="default",
                    clip=None,
                    unit="rad",
                )
            },
            observations={"policy": self._seen(noisy=True), "critic": {**self._seen(noisy=False), **self._known()}},
            rewards=self._rewards(config),
            terminations=self._terminations(config),
            commands={"twist": self._command(config)},
            events=self._events(config),
            curricula=(
                {"terrain_levels": Curriculum(terms.walk_to_levels, episode_seconds=config.episode_seconds)}
                if self.rough
                else {}
            ),
            metrics={
                "mean_action_acc": Metric(terms.mean_action_acceleration),
                "error_vel_xy": Metric(terms.planar_velocity_error),
                "error_vel_yaw": Metric(terms.turning_velocity_error),
                **({"terrain_level": Metric(terms.terrain_level)} if self.rough else {}),
            },
            sensors=self._sensors(config),
            randomize=self.walker.randomize,
        )

    def _sensors(self, config: VelocityConfig) -> Mapping[str, Any]:
        walker = self.walker
        sensors: dict[str, Any] = {
            "imu": Imu(site=walker.imu),
            "feet": walker.touching,
            "soles": Frames(sites=walker.soles),
            "foot_scan": HeightScan(sites=walker.soles, pattern=walker.ring, max_distance=1.0),
            "momentum": AngularMomentum(),
            "tolerances": walker.tolerances,
        }
        if self.rough:
            pattern = GridPattern(size=(1.6, 1.0), resolution=0.1)
            sensors["terrain_scan"] = HeightScan(bodies=walker.base, pattern=pattern, max_distance=FARTHEST_SCAN)
        return sensors

    def _rewards(self, config: VelocityConfig) -> Mapping[str, Reward]:
        """The rewards, each per second."""
        walker, points = self.walker, self.walker.foot_points
        return {
            "track_linear_velocity": rate(terms.track_linear_velocity, std=math.sqrt(0.25)),
            "track_angular_velocity": rate(terms.track_angular_velocity, std=math.sqrt(0.5)),
            "upright": rate(terms.body_upright, bodies=walker.torso, std=math.sqrt(0.2)),
            "pose": rate(terms.commanded_posture, walking=MOVES, running=1.5),
            "body_ang_vel": rate(terms.body_tipping_rate_squared, bodies=walker.torso),
            "angular_momentum": rate(terms.angular_momentum_squared),
            "dof_pos_limits": rate(terms.joint_limit_excess, soft_factor=0.9),
            "action_rate_l2": rate(terms.action_rate_squared),
            "air_time": rate(terms.commanded_time_in_air, contacts="feet", least=0.05, greatest=0.5, threshold=0.5),
            "foot_clearance": rate(
                terms.swung_foot_clearance, scan="foot_scan", points=points, height=FOOT_HEIGHT, threshold=MOVES
            ),
            "foot_swing_height": rate(
                terms.swung_foot_height_error,
                contacts="feet",
                scan="foot_scan",
                points=points,
                height=FOOT_HEIGHT,
                threshold=MOVES,
                memory=len(walker.soles),
            ),
            "foot_slip": rate(terms.foot_slip, contacts="feet", threshold=MOVES),
            "soft_landing": rate(terms.soft_landing, contacts="feet", threshold=MOVES),
        }

    def _terminations(self, config: VelocityConfig) -> Mapping[str, Termination]:
        """A fall, and as a time-out the end of the terrain."""
        ends = {"fell_over": Termination(terms.root_tilted, limit=math.radians(70.0))}
        if terrain := self.terrain(config):
            margin = terrain.border - UNSEEN
            ends["out_of_terrain_bounds"] = Termination(terms.left_terrain, margin=margin, time_out=True)
        return ends

    def _seen(self, noisy: bool) -> Mapping[str, Observation]:
        """Observations of a robot's own sensors; the critic's copies have neither noise nor bias."""

        def measured(function: Any, noise: float, **options: Any) -> Observation:
            return Observation(function, noise=noise if noisy else 0.0, **options)

        position = terms.measured_joint_position if noisy else terms.joint_position
        seen = {
            "base_lin_vel": measured(terms.imu_linear_velocity, 0.5, unit="m/s"),
            "base_ang_vel": measured(terms.imu_angular_velocity, 0.2, unit="rad/s"),
            "projected_gravity": measured(terms.projected_gravity, 0.05),
            "joint_pos": measured(position, 0.01, offset="default", unit="rad"),
            "joint_vel": measured(terms.joint_velocity, 1.5, unit="rad/s"),
            "actions": Observation(terms.last_action),
            "command": Observation(terms.command_vector, names=("command_forward", "command_left", "command_turn")),
        }
        if self.rough:
            scale = 1.0 / FARTHEST_SCAN
            seen["height_scan"] = measured(terms.scanned_height, 0.1, scan="terrain_scan", scale=scale, unit="m")
        return seen

    def _known(self) -> Mapping[str, Observation]:
        """Privileged observations of each foot, for the critic."""
        walker = self.walker
        names = list(walker.soles)
        return {
            "foot_height": Observation(
                terms.frame_clearance,
                scan="foot_scan",
                points=walker.foot_points,
                size=len(names),
                names=[f"{name}_height" for name in names],
                unit="m",
            ),
            "foot_air_time": Observation(terms.air_time, contacts="feet", unit="s"),
            "foot_contact": Observation(terms.in_contact, contacts="feet"),
            "foot_contact_forces": Observation(terms.contact_force_logarithm, contacts="feet"),
        }

    def _command(self, config: VelocityConfig) -> Command:
        stages = {name: getattr(config, f"command_{name}") for name in COMMANDED}
        first = {name: range_at(each, 0) for name, each in stages.items()}
        steer = Term(terms.steer_velocity_command, turn=first["turn"], stiffness=config.heading_stiffness)
        return Command(
            terms.heading_velocity_command,
            names=tuple(stages),
            units=("m/s", "m/s", "rad/s"),
            ranges={name: widest(each) for name, each in stages.items()},
            seconds=config.command_seconds,
            update=steer,
            hidden=6,
            heading=(-math.pi, math.pi),
            standing_share=config.command_stand,
            heading_share=config.command_heading,
            forward_share=config.command_ahead,
            least_forward=0.3,
            **first,
        )

    def _events(self, config: VelocityConfig) -> Mapping[str, Event]:
        return {
            "reset_base": Event(
                terms.reset_root_on_terrain if self.rough else terms.reset_root,
                x=(-0.5, 0.5),
                y=(-0.5, 0.5),
                z=(0.01, 0.05),
                yaw=(-3.14, 3.14),
            ),
            "reset_robot_joints": Event(terms.reset_joints_by_offset, position=(0.0, 0.0), soft_factor=0.9),
            "push_robot": Event(
                terms.push,
                when="interval",
                seconds=config.push_seconds,
                velocity_x=(-0.5, 0.5),
                velocity_y=(-0.5, 0.5),
                velocity_z=(-0.4, 0.4),
                turning_x=(-0.52, 0.52),
                turning_y=(-0.52, 0.52),
                turning_z=(-0.78, 0.78),
            ),
        }


def rate(function: Any, **options: Any) -> Reward:
    """A reward per second."""
    return Reward(function, per_second=True, **options)


def commanded_places(name: str) -> list[str]:
    """The numbers of the declaration that hold the range of a command."""
    return [f"commands.twist.{name}"] + (["commands.twist.update.turn"] if name == "turn" else [])
