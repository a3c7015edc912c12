"""The identity of a robot's compiled model, by which a policy knows again the robot it was trained on."""

from __future__ import annotations

import hashlib
from typing import Any

import mujoco
import newton
import numpy as np

from shared_store.policy_contract import RobotModel
from worker.simulation.robot_elements import name_of, short
from worker.simulation.robot_values import gravity, inertia

_COMPILED = (
    "body_parentid body_pos body_quat body_mass body_ipos body_gravcomp body_mocapid jnt_type jnt_bodyid jnt_pos jnt_axis "
    "jnt_limited jnt_range jnt_stiffness jnt_solref jnt_solimp jnt_margin jnt_actfrclimited jnt_actfrcrange qpos0 qpos_spring "
    "dof_damping dof_armature dof_frictionloss geom_type geom_bodyid geom_size geom_pos geom_quat geom_contype geom_conaffinity "
    "geom_condim geom_friction geom_solref geom_solimp site_bodyid site_pos site_quat tendon_num tendon_range tendon_stiffness "
    "tendon_damping tendon_lengthspring wrap_objid wrap_prm eq_type eq_obj1id eq_obj2id eq_data exclude_signature "
    "actuator_trntype actuator_trnid actuator_dyntype actuator_gaintype actuator_biastype actuator_dynprm actuator_gainprm "
    "actuator_biasprm actuator_gear actuator_ctrlrange actuator_forcerange actuator_delay"
)
"""Arrays of ``mujoco.MjModel`` that say what a robot is."""
_IMPORTED = (
    "body_mass body_com body_inertia joint_type joint_parent joint_child joint_X_p joint_X_c joint_axis joint_limit_lower "
    "joint_limit_upper joint_armature joint_friction joint_damping shape_type shape_body shape_scale shape_transform"
)
"""The same of Newton's builder, where it holds another robot than the file, or MuJoCo doesn't compile the file."""
_NAMED = {
    "body": (mujoco.mjtObj.mjOBJ_BODY, {"mass": "body_mass"}),
    "joint": (
        mujoco.mjtObj.mjOBJ_JOINT,
        {
            "range": "jnt_range",
            "stiffness": "jnt_stiffness",
            "damping": "dof_damping",
            "armature": "dof_armature",
            "frictionloss": "dof_frictionloss",
        },
    ),
    "actuator": (
        mujoco.mjtObj.mjOBJ_ACTUATOR,
        {"gear": "actuator_gear", "forcerange": "actuator_forcerange", "ctrlrange": "actuator_ctrlrange"},
    ),
}
"""By kind of element, its values by which a change is named, and their arrays."""
DIGITS = 5
"""Significant digits of a number that count."""
RESIDUE = 1e-9
"""Share of an array's greatest number up to which a number is what rounding left of 0, which differs between processors."""


def identity(builder: newton.ModelBuilder, reference: Any) -> RobotModel:
    """Identify a robot, without a name.

    Args:
        builder: The robot as its file says, alone.
        reference: The file's compiled model, ``mujoco.MjModel``; None for a USD file.
    """
    if reference is None:
        arrays = {field: getattr(builder, field) for field in _IMPORTED.split()}
        drives = {
            field: builder.custom_attributes[f"mujoco:actuator_{field}"].values or []
            for field in ("gainprm", "biasprm")
        }
        arrays |= drives
        joints, actuators, mass = builder.joint_count, len(drives["gainprm"]), float(sum(builder.body_mass))
        elements = {
            f"body {short(label)}": {"mass": _rounded(own)}
            for label, own in zip(builder.body_label, builder.body_mass, strict=True)
        }
    else:
        moments = [inertia(reference, body) for body in range(reference.nbody)]
        arrays = {field: getattr(reference, field) for field in _COMPILED.split()}
        arrays |= {"inertia": moments, "gravity": gravity(reference)}
        joints, actuators, mass = reference.njnt, reference.nu, float(reference.body_mass.sum())
        elements = _elements(reference)
    return RobotModel("", _digest(arrays), float(f"{mass:.6g}"), int(joints), int(actuators), elements)


def _elements(model: Any) -> dict[str, dict[str, float]]:
    """As :attr:`RobotModel.elements`, of a compiled model."""
    found = {}
    for word, (kind, fields) in _NAMED.items():
        for index in range({"body": model.nbody, "joint": model.njnt, "actuator": model.nu}[word]):
            if (word, index) == ("body", 0):
                continue  # the world
            values: dict[str, float] = {}
            for name, field in fields.items():
                row = model.jnt_dofadr[index] if field.startswith("dof_") else index
                numbers = np.atleast_1d(getattr(model, field)[row])
                places = {1: [""], 2: [" least", " greatest"]}.get(len(numbers)) or [
                    f" {i}" for i in range(len(numbers))
                ]
                values |= {f"{name}{place}": _rounded(value) for place, value in zip(places, numbers, strict=True)}
            found[f"{word} {name_of(model, kind, index)}"] = {name: value for name, value in values.items() if value}
    return found


def _rounded(value: float) -> float:
    return float(f"{value:.{DIGITS}g}")


def _digest(arrays: dict[str, Any]) -> str:
    hashed = hashlib.sha256()
    for field, values in sorted(arrays.items()):
        rows = [list(each) if hasattr(each, "__len__") else each for each in values]
        numbers = np.array(rows, np.float64).ravel()
        numbers = np.where(np.abs(numbers) <= RESIDUE * np.abs(numbers).max(initial=0.0), 0.0, numbers)
        hashed.update(f"{field} {' '.join(f'{number:.{DIGITS}g}' for number in numbers)}\n".encode())
    return hashed.hexdigest()
