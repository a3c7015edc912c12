"""Actuators of a robot, declared by joint-name pattern.

All of them take their inputs from one array, ``WorldArrays.controls``, in the order in which they were declared: a joint position,
a joint velocity or a force, in the joint's own unit. MuJoCo's own actuators are used where they suffice
(:class:`PositionActuator`, :class:`VelocityActuator`, :class:`EffortActuator`), whose damping its implicit integrators know; explicit
motors are computed before each physics step (:mod:`worker.simulation.drives`).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any, ClassVar, Literal

import newton
import warp as wp
from newton.solvers import SolverMuJoCo

from worker.simulation.patterns import find, resolve

FREQUENCY = "mujoco:actuator"
"""Newton's frequency of actuators: one row each, in the order of the controls."""

Number = float | Mapping[str, float]
"""One number for all joints of an actuator, or numbers by joint pattern; the first matching pattern wins."""

Input = Literal["effort", "position", "velocity"]
"""What an actuator takes."""

MOTOR_ATTRIBUTES = {
    "explicit": (wp.int32, 0),
    "stiffness": (wp.float32, 0.0),
    "damping": (wp.float32, 0.0),
    "effort_limit": (wp.float32, math.inf),
    "saturation_effort": (wp.float32, math.inf),
    "velocity_limit": (wp.float32, math.inf),
    "delay": (wp.int32, 0),
}
"""Actuator attributes that a model carries beside MuJoCo's parameters, as ``model.muster.NAME`` (worlds x actuators rows): whether the
force is computed explicitly, its gains and limits, and the delay of the input [physics steps]."""


@dataclass(frozen=True)
class Actuator:
    """Arguments common to all actuators.

    Args:
        joints: Joint-name patterns; each matching joint gets its own actuator.
        effort_limit: Greatest force on a joint [N, N m]; None: not limited.
        armature: Inertia of the rotor, reflected to the joint [kg, kg m^2]; None: as in the file.
        friction_loss: Dry friction of the joint [N, N m]; None: as in the file.
        viscous_damping: Damping of the joint itself [N s/m, N m s/rad]; None: as in the file.
        delay: Physics steps before an input takes effect. At the beginning of an episode the oldest input so far is used.
    """

    joints: str | Sequence[str]
    effort_limit: Number | None = field(default=None, kw_only=True)
    armature: Number | None = field(default=None, kw_only=True)
    friction_loss: Number | None = field(default=None, kw_only=True)
    viscous_damping: Number | None = field(default=None, kw_only=True)
    delay: int = field(default=0, kw_only=True)

    positive: ClassVar[tuple[str, ...]] = ("effort_limit", "saturation_effort", "velocity_limit")
    """Numbers that must be greater than 0; the others must not be negative."""

    def __post_init__(self) -> None:
        for item in fields(self):
            value, is_positive = getattr(self, item.name), item.name in self.positive
            if item.name == "joints" or value is None:
                continue
            for number in value.values() if isinstance(value, Mapping) else (value,):
                is_number = isinstance(number, int | float) and not isinstance(number, bool)
                if not is_number or not number >= 0 or (is_positive and number == 0):
                    least = "greater than 0" if is_positive else "0 or more"
                    raise ValueError(f"{self}: {item.name} must be {least}, not {number!r}")
        if not isinstance(self.delay, int):
            raise ValueError(f"{self}: delay is a whole number of physics steps, not {self.delay!r}")

    def __str__(self) -> str:
        return f"{type(self).__name__}({self.joints!r})"

    def row(self, numbers: Mapping[str, float]) -> dict[str, Any]:
        """MuJoCo's and the model's own parameters of one joint's actuator, of the declaration's numbers for this joint."""
        raise NotImplementedError


@dataclass(frozen=True)
class PositionActuator(Actuator):
    """MuJoCo's position servo: ``stiffness (input - position) - damping velocity``, limited to ``effort_limit``.

    The input is a joint position [rad, m] and may lie beyond the joint's limits, so that a joint at its limit can still be pushed.
    Implicit integrators take the damping into account, so that stiff servos are stable at long physics steps.

    Args:
        stiffness: [N/m, N m/rad].
        damping: [N s/m, N m s/rad].
    """

    stiffness: Number
    damping: Number

    def row(self, numbers: Mapping[str, float]) -> dict[str, Any]:
        kp, kd = numbers["stiffness"], numbers["damping"]
        return _native(SolverMuJoCo.CtrlType.POSITION, kp, (0.0, -kp, -kd), numbers.get("effort_limit"))


@dataclass(frozen=True)
class VelocityActuator(Actuator):
    """MuJoCo's velocity servo: ``damping (input - velocity)``, limited to ``effort_limit``; the input is a joint velocity [rad/s, m/s].

    Args:
        damping: [N s/m, N m s/rad].
    """

    damping: Number

    def row(self, numbers: Mapping[str, float]) -> dict[str, Any]:
        kd = numbers["damping"]
        return _native(SolverMuJoCo.CtrlType.VELOCITY, kd, (0.0, 0.0, -kd), numbers.get("effort_limit"))


@dataclass(frozen=True)
class EffortActuator(Actuator):
    """The input is the force [N, N m], limited to ``effort_limit``."""

    def row(self, numbers: Mapping[str, float]) -> dict[str, Any]:
        return _native(SolverMuJoCo.CtrlType.GENERAL, 1.0, None, numbers.get("effort_limit"))


@dataclass(frozen=True)
class ExplicitPDActuator(Actuator):
    """``stiffness (input - position) - damping velocity``, computed before each physics step as a robot's own controller does.

    Unlike :class:`PositionActuator` the force stays the same during the step: stiff gains need short steps.

    Args:
        stiffness: [N/m, N m/rad].
        damping: [N s/m, N m s/rad].
    """

    stiffness: Number
    damping: Number

    def row(self, numbers: Mapping[str, float]) -> dict[str, Any]:
        row = _native(SolverMuJoCo.CtrlType.GENERAL, 1.0, None, numbers.get("effort_limit"))
        motor = {name: value for name, value in numbers.items() if name in MOTOR_ATTRIBUTES}
        return row | {f"muster:{name}": value for name, value in motor.items()} | {"muster:explicit": 1}


@dataclass(frozen=True)
class DCMotorActuator(ExplicitPDActuator):
    """:class:`ExplicitPDActuator` limited by the torque-speed line of a DC motor.

    The force is at most ``min(saturation_effort (1 - velocity / velocity_limit), effort_limit)``, and likewise in the other direction
    (``newton.actuators.ClampingDCMotor``): a motor that turns fast can brake harder than it can accelerate.

    Args:
        saturation_effort: Force at standstill [N, N m].
        velocity_limit: Velocity without load [rad/s, m/s].
    """

    saturation_effort: Number
    velocity_limit: Number


def register(builder: newton.ModelBuilder) -> None:
    """Register :data:`MOTOR_ATTRIBUTES` with a builder."""
    for name, (dtype, default) in MOTOR_ATTRIBUTES.items():
        builder.add_custom_attribute(
            newton.ModelBuilder.CustomAttribute(
                name=name, dtype=dtype, frequency=FREQUENCY, default=default, namespace="muster"
            )
        )


def clear(builder: newton.ModelBuilder) -> None:
    """Remove all actuators that came from a file."""
    for attribute in builder.custom_attributes.values():
        if attribute.frequency == FREQUENCY:
            attribute.values = []
    # Newton has no call that removes a row
    builder._custom_frequency_counts[FREQUENCY] = 0


def add(
    builder: newton.ModelBuilder, names: Sequence[str], dofs: Sequence[int], actuators: Iterable[Actuator], robot: str
) -> None:
    """Give a builder of one robot its actuators; ``dofs`` are the columns in ``joint_qd`` of its joints of one degree of freedom.

    Raises:
        ValueError: A pattern matches nothing, two actuators drive one joint, or a number is given for only some of an actuator's joints.
    """
    driven: dict[int, Actuator] = {}
    columns = {
        "armature": builder.joint_armature,
        "friction_loss": builder.joint_friction,
        "viscous_damping": builder.joint_damping,
    }
    defaults = {key: each.default for key, each in builder.custom_attributes.items() if each.frequency == FREQUENCY}
    for actuator in actuators:
        try:
            joints = find(names, actuator.joints, f"joint of {robot}")
        except ValueError as error:
            raise ValueError(f"{robot}: {actuator}: {error}") from error
        for joint in joints:
            if joint in driven:
                raise ValueError(
                    f"{robot}: two actuators drive the joint {names[joint]}: {driven[joint]} and {actuator}; "
                    "narrow the patterns of one"
                )
            driven[joint] = actuator
        chosen = [names[joint] for joint in joints]
        numbers = _numbers(actuator, chosen, robot)
        for index, joint in enumerate(joints):
            mine = {name: each[index] for name, each in numbers.items()}
            for name, values in columns.items():
                if name in mine:
                    values[dofs[joint]] = mine[name]
            row = actuator.row(mine) | {"muster:delay": actuator.delay}
            row["mujoco:actuator_trnid"] = wp.vec2i(dofs[joint], 0)
            row["mujoco:actuator_label"] = names[joint]
            row["mujoco:actuator_world"] = builder.current_world
            builder.add_custom_values(**defaults | row)


def _numbers(actuator: Actuator, names: Sequence[str], robot: str) -> dict[str, list[float]]:
    """The declaration's numbers for each of its joints, without those that are None."""
    numbers: dict[str, list[float]] = {}
    for item in fields(actuator):
        value = getattr(actuator, item.name)
        if item.name in ("joints", "delay") or value is None:
            continue
        resolved = resolve(names, value, f"joint of {actuator} of {robot}")
        for name, number in zip(names, resolved, strict=True):
            if number is None:
                raise ValueError(
                    f"{robot}: {actuator}: no pattern of {item.name} matches the joint {name}; add '*' as the last one"
                )
        numbers[item.name] = [float(number) for number in resolved if number is not None]
    return numbers


def _native(kind: Any, gain: float, bias: Sequence[float] | None, effort_limit: float | None) -> dict[str, Any]:
    """An actuator of MuJoCo whose force is ``gain input`` plus, where there is a bias, ``b0 + b1 position + b2 velocity``.

    Source of the formula: MuJoCo's documentation, Computation, actuation model (``mjGAIN_FIXED``, ``mjBIAS_AFFINE``).
    """
    ten = wp.types.vector(10, wp.float32)
    row: dict[str, Any] = {
        "mujoco:ctrl_source": int(SolverMuJoCo.CtrlSource.CTRL_DIRECT),
        "mujoco:ctrl_type": int(kind),
        "mujoco:actuator_trntype": int(SolverMuJoCo.TrnType.JOINT),
        "mujoco:actuator_gaintype": 0,
        "mujoco:actuator_biastype": 0 if bias is None else 1,
        "mujoco:actuator_gainprm": ten(gain, *[0.0] * 9),
        "mujoco:actuator_biasprm": ten(*(bias or (0.0, 0.0, 0.0)), *[0.0] * 7),
        "mujoco:actuator_ctrllimited": 0,
        "mujoco:actuator_forcelimited": 0,
    }
    if effort_limit is not None and math.isfinite(effort_limit):
        row["mujoco:actuator_forcelimited"] = row["mujoco:actuator_has_forcerange"] = 1
        row["mujoco:actuator_forcerange"] = wp.vec2(-effort_limit, effort_limit)
    return row
