"""``python -m worker.robot FILE`` describes a robot's file as JSON. ``muster robot`` runs it, since it imports no simulation itself."""

from __future__ import annotations

import argparse
import json
import math
import sys
import warnings
from functools import partial
from pathlib import Path
from typing import Any

import mujoco
import newton
import numpy as np
import warp as wp

from worker.settings.task import TaskConfig
from worker.simulation.robot import Robot
from worker.simulation.robot_comparison import RobotDifference
from worker.simulation.robot_elements import Ends, equality_ends, kind_of, name_of, short, tendon_ends, word_of
from worker.simulation.robot_reading import AnotherRobot, Reading
from worker.simulation.robot_values import shown_value
from worker.simulation.robot_view import RobotView, actuator_value, actuators_of_dofs, is_limited, joint_of
from worker.tasks.run.task import Task
from worker.telemetry import picture
from worker.telemetry.stage import Stage

PICTURE = (960, 720)
"""Width and height [px]."""


def describe(file: str, reading: Reading) -> dict[str, Any]:
    """A robot in plain values: angles in radians, lengths in metres, masses in kilograms.

    Args:
        file: The file's name.
        reading: How its file was read.
    """
    builder, view = reading.builder, RobotView(reading.builder, "")
    reference = reading.reference
    model = reference.model if reference else None
    actuators = _actuators(model) if model else _drives(builder, view)
    notes = [*reading.notes, *view.beyond_limits()]
    if view.joint_names and not actuators:
        notes.append("it has no actuators: a task declares some, or has passive=True")
    return {
        "file": file,
        "mass": reading.identity.mass,
        "digest": reading.identity.digest,
        "fixed": view.root_coordinate < 0,
        "bodies": [
            {"name": name, "mass": builder.body_mass[body]}
            for name, body in zip(view.body_names, view.bodies, strict=True)
        ],
        "joints": [*(_joint(builder, view, joint) for joint in range(len(view.joint_names))), *_balls(model)],
        "actuators": actuators,
        "tendons": _tendons(model),
        "equalities": _equalities(model),
        "sensors": [{"name": name, "kind": kind} for name, kind in reference.sensors] if reference else [],
        "sites": view.site_names,
        "corrected": [_difference(each) for each in reading.corrected],
        "notes": notes,
    }


def _joint(builder: newton.ModelBuilder, view: RobotView, joint: int) -> dict[str, Any]:
    dof = view.dofs[joint]
    whole = joint_of(builder, dof)
    is_linear = dof - builder.joint_qd_start[whole] < builder.joint_dof_dim[whole][0]
    lower, upper, effort = (
        limit if math.isfinite(limit) else None for limit in (*view.ranges[joint], view.efforts[joint])
    )
    return {
        "name": view.joint_names[joint],
        "kind": "slide" if is_linear else "hinge",
        "lower": lower,
        "upper": upper,
        "default": view.defaults[joint],
        "stiffness": builder.joint_stiffness[dof],
        "damping": builder.joint_damping[dof],
        "armature": builder.joint_armature[dof],
        "friction_loss": builder.joint_friction[dof],
        "effort_limit": effort,
    }


def _balls(model: Any) -> list[dict[str, Any]]:
    """Joints of three degrees of freedom, which have no position that a number could say; none of a USD file."""
    return [
        {
            **dict.fromkeys(("lower", "upper", "default", "effort_limit")),
            "name": name_of(model, kind_of("joint"), joint),
            "kind": "ball",
            "stiffness": float(model.jnt_stiffness[joint]),
            "damping": float(model.dof_damping[model.jnt_dofadr[joint]]),
            "armature": float(model.dof_armature[model.jnt_dofadr[joint]]),
            "friction_loss": float(model.dof_frictionloss[model.jnt_dofadr[joint]]),
        }
        for joint in (range(model.njnt) if model else ())
        if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_BALL
    ]


def _tendons(model: Any) -> list[dict[str, Any]]:
    """The tendons of a compiled model; none of a USD file."""
    return [
        {
            "name": name_of(model, kind_of("tendon"), tendon),
            "connects": _named(model, tendon_ends(model, tendon)),
            "lower": float(model.tendon_range[tendon, 0]) if model.tendon_limited[tendon] else None,
            "upper": float(model.tendon_range[tendon, 1]) if model.tendon_limited[tendon] else None,
            "stiffness": float(model.tendon_stiffness[tendon]),
            "damping": float(model.tendon_damping[tendon]),
        }
        for tendon in (range(model.ntendon) if model else ())
    ]


def _equalities(model: Any) -> list[dict[str, Any]]:
    """The equalities of a compiled model; none of a USD file."""
    return [
        {
            "name": name_of(model, kind_of("equality"), equality),
            "kind": word_of(mujoco.mjtEq, model.eq_type[equality]),
            "connects": _named(model, equality_ends(model, equality)),
            "active": bool(model.eq_active0[equality]),
        }
        for equality in (range(model.neq) if model else ())
    ]


def _named(model: Any, ends: Ends) -> list[str]:
    return [f"{kind} {name_of(model, kind_of(kind), index)}" for kind, index in ends if kind != "pulley" and index >= 0]


def _actuators(model: Any) -> list[dict[str, Any]]:
    """Those of a compiled model, ``mujoco.MjModel``."""
    found = []
    for actuator in range(model.nu):
        kind = word_of(mujoco.mjtTrn, model.actuator_trntype[actuator])
        target = {"jointinparent": "joint", "slidercrank": "site"}.get(kind, kind)
        limits = {
            name: values[actuator] if limited[actuator] else None
            for name, limited, values in (
                ("control", model.actuator_ctrllimited, model.actuator_ctrlrange),
                ("force", model.actuator_forcelimited, model.actuator_forcerange),
            )
        }
        found.append(
            _actuator(
                name_of(model, kind_of("actuator"), actuator),
                f"{kind} {name_of(model, kind_of(target), int(model.actuator_trnid[actuator, 0]))}",
                model.actuator_gear[actuator],
                (model.actuator_gaintype[actuator], model.actuator_gainprm[actuator]),
                (model.actuator_biastype[actuator], model.actuator_biasprm[actuator]),
                word_of(mujoco.mjtDyn, model.actuator_dyntype[actuator]),
                limits,
            )
        )
    return found


def _drives(builder: newton.ModelBuilder, view: RobotView) -> list[dict[str, Any]]:
    """Those of a USD file: drives of joints, and actuators of MuJoCo's schema on joints."""
    found = []
    for actuator, dof in sorted((actuator, dof) for dof, actuator in actuators_of_dofs(builder).items()):
        value = partial(actuator_value, builder, actuator=actuator)
        limits = {
            name: value(f"actuator_{word}range") if is_limited(builder, word, actuator) else None
            for name, word in (("control", "ctrl"), ("force", "force"))
        }
        joint = view.joint_names[view.dofs.index(dof)]
        dynamics = word_of(mujoco.mjtDyn, value("actuator_dyntype"))
        found.append(
            _actuator(
                short(value("actuator_label")) or joint,
                f"joint {joint}",
                value("actuator_gear"),
                (value("actuator_gaintype"), value("actuator_gainprm")),
                (value("actuator_biastype"), value("actuator_biasprm")),
                dynamics,
                limits,
            )
        )
    return found


Numbers = tuple[int, Any]
"""Kind of a gain or bias, and its numbers."""


def _actuator(
    name: str, target: str, gear: Any, gain: Numbers, bias: Numbers, dynamics: str, limits: dict[str, Any]
) -> dict[str, Any]:
    """Source of the names: MuJoCo's documentation, actuation model; its force is ``gain input + b0 + b1 length + b2 velocity``.

    None stands for what such an actuator has not: a damper's force is ``-damping input velocity``, a muscle's depends on its length.
    """
    kind, numbers = word_of(mujoco.mjtGain, gain[0]), gain[1]
    law: dict[str, Any] = dict.fromkeys(("gain", "bias", "stiffness", "damping"))
    if kind in ("affine", "fixed"):
        biases = [0.0] * 3 if bias[0] == mujoco.mjtBias.mjBIAS_NONE else [float(each) for each in bias[1][:3]]
        forces = [float(each) for each in numbers[:3]] if kind == "affine" else biases
        # without the sign of a zero
        law = {"gain": float(numbers[0]) or 0.0, "bias": biases}
        law |= {"stiffness": -forces[1] or 0.0, "damping": -forces[2] or 0.0}
    return {
        "name": name,
        "drives": target,
        "gear": float(gear[0]),
        **law,
        "law": kind,
        "dynamics": dynamics,
        **{f"{word}_range": None if pair is None else [float(each) for each in pair] for word, pair in limits.items()},
    }


def _difference(difference: RobotDifference) -> dict[str, str]:
    return {
        "element": difference.element,
        "field": difference.field,
        "here": shown_value(difference.built),
        "file": shown_value(difference.file),
    }


def draw(robot: Robot, path: Path) -> None:
    """Draw a robot in its default pose. Raises UserError if the file can't be written."""

    class Alone(Task):
        def robot(self, config: TaskConfig) -> Robot:
            return robot

        def build(self, builder: newton.ModelBuilder) -> None:
            self.readings = {robot.name: robot.add_to(builder)}
            self.views = {robot.name: RobotView(builder, robot.name)}
            self.ground_terrain = None

    stage = Stage(Alone, TaskConfig(), 1)
    image = picture.StageCamera(stage, *PICTURE).take(np.array([stage.model.joint_q.numpy()]))
    picture.write(path, picture.encode([image], ".png", 1.0))


def main() -> int:
    """Print the description, or why the file is refused; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m worker.robot", description=__doc__)
    parser.add_argument("file", help="as Robot's: a path, package:NAME/path, newton:NAME")
    parser.add_argument("--picture", type=Path, help="draw the robot in its default pose into this PNG file")
    parser.add_argument("--fixed", action=argparse.BooleanOptionalAction, help="as Robot's")
    parser.add_argument("--ignore", action="append", help="as one of Robot's")
    parser.add_argument("--accept", action="append", default=[], help="as one of Robot's")
    options = parser.parse_args()
    wp.config.log_level = wp.LOG_ERROR
    warnings.simplefilter("ignore")
    ignored = {} if options.ignore is None else {"ignore": options.ignore}
    robot = Robot(options.file, passive=True, fixed=options.fixed, accept=options.accept, **ignored)
    try:
        reading = robot.read()
    except ValueError as error:
        another = error.__cause__ if isinstance(error.__cause__, AnotherRobot) else None
        refused = [_difference(each) for each in another.differences] if another else []
        print(json.dumps({"file": options.file, "error": str(error).removeprefix("robot: "), "differences": refused}))
        return 0
    described = describe(options.file, reading)
    if options.picture:
        draw(robot, options.picture)
        described["picture"] = str(options.picture)
    print(json.dumps(described))
    return 0


if __name__ == "__main__":
    sys.exit(main())
