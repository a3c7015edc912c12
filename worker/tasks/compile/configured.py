"""The parts that a job's configuration adds to a declaration: randomised physics, pushes, noise, a camera."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from fnmatch import fnmatchcase
from typing import Any

import warp as wp

from shared_store.contract.error_text import nearest
from worker.settings.camera import CameraConfig
from worker.settings.task import FACTORS, TaskConfig
from worker.simulation.declared_randomization import Randomize
from worker.simulation.episodes import EpisodeArrays
from worker.simulation.robot_arrays import RobotArrays
from worker.simulation.robot_view import RobotView
from worker.simulation.sensors.camera import CameraSensor
from worker.simulation.worlds import WorldArrays
from worker.tasks.declare.declaration import Declaration, Event, Image
from worker.tasks.declare.interface import Observation

wp.set_module_options({"enable_backward": False})

CAMERA = "camera"
"""Name of the sensor and of the field of a configuration that describes it."""
FACTOR = "config_{}"
"""Name of the entry that applies a factor of ``config.randomize``."""
_FACTORS: Mapping[str, tuple[str, Mapping[str, Any]]] = {
    "mass": ("mass", {"bodies": "*"}),
    "friction": ("contact_friction", {"geoms": "*"}),
    "damping": ("joint_damping", {"joints": "*"}),
    "gains": ("motor_strength", {"actuators": "*"}),
    "gravity": ("gravity", {}),
}
"""Quantity and parts of each factor of ``config.randomize``."""
FACTOR_STREAMS = {FACTOR.format(name): -1 - number for number, name in enumerate(FACTORS)}
"""Numbers of their random streams: what one is does not depend on what else is drawn."""


@wp.func
def push_at_random(
    world: int,
    worlds: WorldArrays,
    episodes: EpisodeArrays,
    robot: RobotArrays,
    stream: wp.uint32,
    probability: float,
    velocity: float,
):
    """Now and then change the root's horizontal velocity at once, by up to +- ``velocity`` [m/s] times the curriculum's level.

    :func:`.push` has no probability and level, and draws six numbers: other bits for the same seed.
    """
    if wp.randf(stream) < probability:
        for axis in range(2):
            change = episodes.level[0] * velocity * wp.randf(stream, -1.0, 1.0)
            worlds.joint_qd[world, robot.root_dof + axis] = worlds.joint_qd[world, robot.root_dof + axis] + change


def configured(declaration: Declaration, config: TaskConfig, views: Mapping[str, RobotView]) -> Declaration:
    """The declaration with the randomisation, the pushes and the camera of a configuration; they follow the task's own entries.

    Args:
        declaration: Of the task.
        config: Its configuration.
        views: Its robots and objects by name.

    Raises:
        ValueError: The robot is to be pushed, and is fixed to the world.
    """
    randomize, changes = config.randomize, dict[str, Any]()
    factors = {
        FACTOR.format(name): Randomize(what, **parts, range=ends, shared=True, robot=None)
        for name, (what, parts) in _FACTORS.items()
        if (ends := getattr(randomize, name)) != (1.0, 1.0)
    }
    if factors:
        changes["randomize"] = {**declaration.randomize, **factors}
    if randomize.push_interval:
        if views["robot"].root_dof < 0:
            raise ValueError("config.randomize.push_velocity: the robot is fixed to the world, so it can't be pushed")
        step = 1.0 / config.control_hz
        share = min(1.0, step / randomize.push_interval)
        push = Event(
            push_at_random,
            when="interval",
            seconds=(step, step),
            probability=share,
            velocity=randomize.push_velocity,
        )
        changes["events"] = {**declaration.events, "config_push": push}
    camera = getattr(config, CAMERA, None)
    if isinstance(camera, CameraConfig):
        changes["sensors"] = {**declaration.sensors, CAMERA: CameraSensor(**dataclasses.asdict(camera))}
        groups = declaration.groups
        changes["observations"] = {"critic": groups["policy"], **groups, "policy": Image(CAMERA)}
    return dataclasses.replace(declaration, **changes) if changes else declaration


def deviations(noise: float | Mapping[str, float], observations: Sequence[Observation]) -> list[float]:
    """Standard deviation of the noise of ``config.randomize`` on each observation [its unit]; only measured ones are noisy.

    Args:
        noise: As :attr:`worker.settings.task.Randomization.observation_noise`.
        observations: Of the policy.

    Raises:
        ValueError: A name fits no observation that is measured.
    """
    measured = [index for index, seen in enumerate(observations) if seen.kind == "measured"]
    found = [0.0] * len(observations)
    if not isinstance(noise, Mapping):
        for index in measured:
            if scale := abs(observations[index].scale):  # else the policy sees nothing of it
                found[index] = float(noise) / scale
        return found
    for pattern, deviation in noise.items():
        fitting = [index for index in measured if fnmatchcase(observations[index].name, pattern)]
        if not fitting:
            names = [observations[index].name for index in measured]
            raise ValueError(f"no observation that is measured is called {pattern!r}; {nearest(pattern, names)}")
        for index in fitting:
            found[index] = deviation
    return found
