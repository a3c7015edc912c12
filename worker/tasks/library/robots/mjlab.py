"""Files and servos of the robots in the Python package ``mjlab`` (Apache-2.0). Only its files are read; none of its code runs."""

from __future__ import annotations

import importlib.util
import math
from collections.abc import Mapping, Sequence

from worker.simulation.actuators import PositionActuator
from worker.simulation.declared_randomization import Distribution, Randomize

VERSION = "1.6.0"
"""The mjlab release whose numbers these robots and their tasks use."""
NATURAL_FREQUENCY = 20.0 * math.pi
"""Natural frequency of the servos [rad/s]: 10 Hz, mjlab's choice for all robots here."""
DAMPING_RATIO = 2.0
"""Of the servos."""
ACTION_SHARE = 0.25
"""Torque of an action of 1 at rest, as a share of a servo's greatest torque."""


def robot_file(inside: str) -> str:
    """A file of the package, in the form that :class:`worker.simulation.robot.Robot` accepts.

    Args:
        inside: Its path in the package.

    Raises:
        ValueError: The package is not installed.
    """
    if importlib.util.find_spec("mjlab") is None:
        raise ValueError(
            "the robot's file is in the Python package mjlab, which is not installed; "
            f"install it without its dependencies: pip install --no-deps mjlab=={VERSION}"
        )
    return f"package:mjlab/{inside}"


def servo(joints: str | Sequence[str], rotor: float, effort: float) -> PositionActuator:
    """A position servo whose gains follow from its rotor.

    ``stiffness = rotor w^2`` and ``damping = 2 d rotor w``, with :data:`NATURAL_FREQUENCY` w and :data:`DAMPING_RATIO` d.

    Args:
        joints: Patterns of joints.
        rotor: Inertia of the rotor, reflected to the joint [kg m^2].
        effort: Greatest torque [N m].
    """
    return PositionActuator(
        joints,
        rotor * NATURAL_FREQUENCY**2,
        2.0 * DAMPING_RATIO * rotor * NATURAL_FREQUENCY,
        effort_limit=effort,
        armature=rotor,
    )


def action_scale(servos: Sequence[PositionActuator]) -> Mapping[str, float]:
    """Displacement of each joint's target for an action of 1 [rad], by the patterns of the servos' joints."""
    scales: dict[str, float] = {}
    for each in servos:
        assert isinstance(each.effort_limit, float) and isinstance(each.stiffness, float)
        for pattern in [each.joints] if isinstance(each.joints, str) else each.joints:
            scales[pattern] = ACTION_SHARE * each.effort_limit / each.stiffness
    return scales


FRICTION: tuple[tuple[str, str, tuple[float, float], Distribution], ...] = (
    ("slide", "slide", (0.3, 1.5), "uniform"),
    ("spin", "torsion", (1.0e-4, 2.0e-2), "log_uniform"),
    ("roll", "roll", (1.0e-5, 5.0e-3), "log_uniform"),
)
"""Sliding, torsional [m] and rolling [m] coefficients of the spheres of feet and fingertips: mjlab's name, axis, range, distribution."""


def friction(name: str, geoms: str | tuple[str, ...], *, shared: bool) -> Mapping[str, Randomize]:
    """Entries ``name_slide``, ``name_spin`` and ``name_roll``, drawn once for each world: of all geoms if ``shared``, or of each."""
    return {
        f"{name}_{each}": Randomize(
            "friction", geoms=geoms, axes=(axis,), range=ends, operation="set", distribution=distribution, shared=shared
        )
        for each, axis, ends, distribution in FRICTION
    }


def walking(torso: str) -> Mapping[str, Randomize]:
    """The encoders' bias of a legged robot [rad], and the place of its torso's centre of mass [m]."""
    place = {"x": (-0.025, 0.025), "y": (-0.025, 0.025), "z": (-0.03, 0.03)}
    return {
        "encoder_bias": Randomize("encoder_bias", joints="*", range=(-0.015, 0.015), operation="add"),
        "base_com": Randomize("center_of_mass", bodies=torso, range=place, operation="add"),
    }
