"""Values of a compiled model, in forms that do not depend on how frames and axes are chosen."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np

from worker.simulation.robot_elements import matrix, word_of

UNLIMITED = 1e6
"""Newton's effort limit of joints without one in their file [N, N m]."""


def gravity(model: Any) -> Any:
    """Acceleration by gravity, 0 where the file disables it [m/s^2], shape ``(3,)``."""
    return model.opt.gravity * (not model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_GRAVITY))


def length(model: Any) -> float:
    """Size of the robot [m], to which differences of places are compared."""
    return float(max(model.stat.extent, 1e-3))


def inertia(model: Any, body: int) -> Any:
    """Moments of inertia about the centre of mass in the body's own frame [kg m^2], shape ``(3, 3)``."""
    rotation = matrix(model.body_iquat[body])
    return rotation @ np.diag(model.body_inertia[body]) @ rotation.T


def effort(model: Any, joint: int) -> tuple[float, float]:
    """Least and greatest force of all actuators on a joint [N, N m]; two zeros: not limited."""
    lower, upper = model.jnt_actfrcrange[joint]
    limited = model.jnt_actfrclimited[joint] and max(-lower, upper) < UNLIMITED
    return (float(lower), float(upper)) if limited else (0.0, 0.0)


def extent(model: Any, geom: int) -> Any:
    """A geom's size and pose as numbers that do not depend on how its frame is chosen, in its body's frame [m]."""
    position, axes, size = model.geom_pos[geom], matrix(model.geom_quat[geom]), model.geom_size[geom]
    kind = word_of(mujoco.mjtGeom, model.geom_type[geom])
    if kind == "mesh":
        mesh = model.geom_dataid[geom]
        first, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
        points = position + model.mesh_vert[first : first + count] @ axes.T
        return np.array([points.min(0), points.max(0)])
    if kind == "hfield":
        field = model.geom_dataid[geom]
        first, count = model.hfield_adr[field], model.hfield_nrow[field] * model.hfield_ncol[field]
        return np.concatenate(
            [position, axes.ravel(), model.hfield_size[field], model.hfield_data[first : first + count]]
        )
    if kind == "plane":
        return np.vstack([axes[:, 2] * (position @ axes[:, 2]), axes[:, 2]])
    half_sizes = {
        "sphere": (size[0],) * 3,
        "capsule": (size[0], size[0], size[0] + size[1]),
        "cylinder": (size[0], size[0], size[1]),
    }
    half = np.diag(np.square(half_sizes.get(kind, size)))
    return np.vstack([position, axes @ half @ axes.T])


def from_actuators(model: Any, name: str) -> tuple[Any, Any]:
    """What actuators add to the ``damping``, ``dampingpoly`` or ``armature`` of their joints and tendons, by the square of their gears.

    Source: MuJoCo's XML reference, actuator, ``damping`` and ``armature``.

    Returns:
        Of the degrees of freedom and of the tendons, shapes ``(nv, ...)`` and ``(ntendon, ...)``, in the units of the value.
    """
    values = getattr(model, f"actuator_{name}")
    dofs, tendons = (np.zeros((count, *values.shape[1:])) for count in (model.nv, model.ntendon))
    for actuator in np.flatnonzero(values.reshape(model.nu, -1).any(1)) if model.nu else ():
        target, share = model.actuator_trnid[actuator, 0], values[actuator] * model.actuator_gear[actuator, 0] ** 2
        if model.actuator_trntype[actuator] == int(mujoco.mjtTrn.mjTRN_TENDON):
            tendons[target] += share
        else:  # MuJoCo accepts these values with a joint or a tendon alone
            dofs[model.dof_jntid == target] += share
    return dofs, tendons


def has_mask(model: Any, geom: int) -> bool:
    """Whether a geom can touch others by its masks."""
    return bool(model.geom_contype[geom] or model.geom_conaffinity[geom])


def touching(model: Any) -> Any:
    """Which geoms can touch by their masks, excluded bodies and kinship, shape ``(geoms, geoms)``, bool.

    Source: MuJoCo's documentation, Computation, collision, selection.
    """
    masks, affinities = model.geom_contype.astype(np.int64), model.geom_conaffinity.astype(np.int64)
    agree = (masks[:, None] & affinities) | (affinities[:, None] & masks)
    welded = model.body_weldid[model.geom_bodyid]
    parents = model.body_weldid[model.body_parentid[welded]]
    same = welded[:, None] == welded
    kin = (parents[:, None] == welded) & (welded[:, None] != 0) & (welded != 0)
    if model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_FILTERPARENT):
        kin = np.zeros_like(same)
    excluded = np.zeros((model.nbody, model.nbody), bool)
    for signature in model.exclude_signature:
        first, second = int(signature) >> 16, int(signature) & 0xFFFF
        excluded[first, second] = excluded[second, first] = True
    bodies = model.geom_bodyid
    return (agree != 0) & ~same & ~kin & ~kin.T & ~excluded[bodies[:, None], bodies]


def without_contacts(model: Any) -> Any:
    """A copy of a model without contacts, in which the other constraints are solved exactly, and alone: MuJoCo-Warp has no noslip solver."""
    copied = copy.copy(model)
    copied.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    copied.opt.solver, copied.opt.tolerance, copied.opt.iterations = int(mujoco.mjtSolver.mjSOL_NEWTON), 1e-10, 200
    copied.opt.noslip_iterations = 0
    return copied


def freedoms(model: Any, joint: int) -> int:
    """Number of a joint's degrees of freedom; a joint of several has a quaternion, and so one coordinate more."""
    return {"free": 6, "ball": 3}.get(word_of(mujoco.mjtJoint, model.jnt_type[joint]), 1)


def move_joint(twins: Sequence[tuple[Any, Any, int]], amount: float, random: np.random.Generator) -> None:
    """Move a joint in several models, each with data and the joint's index, by the same random amount, and let it move on.

    ``amount`` is the greatest displacement [m, rad], and a tenth of the greatest velocity [m/s, rad/s].
    """
    model, _, joint = twins[0]
    count = freedoms(model, joint)
    moved, velocity = random.uniform(-amount, amount, count), 10.0 * random.uniform(-amount, amount, count)
    for model, data, joint in twins:
        coordinate, dof = model.jnt_qposadr[joint], model.jnt_dofadr[joint]
        data.qvel[dof : dof + count] = velocity
        if count == 6:
            data.qpos[coordinate : coordinate + 3] += moved[:3]
        if count == 1:
            data.qpos[coordinate] += moved[0]
        else:
            quaternion = data.qpos[coordinate + count - 3 : coordinate + count + 1]
            mujoco.mju_quatIntegrate(quaternion, moved[-3:], 1.0)


def shown_value(value: Any) -> str:
    """A value, or the first of several, for a sentence."""
    if isinstance(value, str | bool | np.bool_):
        return str(value)
    numbers = np.atleast_1d(value).ravel()
    text = " ".join(f"{number:.6g}" for number in numbers[:9])
    return f"({text})" if len(numbers) > 1 else text
