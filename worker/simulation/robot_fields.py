"""Fields of the elements of a compiled model: what makes a robot the one that it is, for its judge and for its identity."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np

from worker.simulation.robot_elements import (
    actuator_ends,
    equality_ends,
    held,
    matrix,
    pair_ends,
    tendon_ends,
    tendon_numbers,
    word_of,
)
from worker.simulation.robot_values import effort, extent, freedoms, has_mask, inertia

Values = dict[str, Any]
"""Values of one element by their names: numbers, arrays or words, and under :data:`ENDS` what it connects."""
ENDS = ("parent", "body", "geoms", "path", "drives", "between")
ELSEWHERE = (
    *("mjDSBL_MULTICCD", "mjENBL_SLEEP", "mjDSBL_SENSOR", "mjDSBL_GRAVITY", "mjENBL_ENERGY", "mjENBL_FWDINV"),
    *("mjDSBL_MIDPHASE", "mjDSBL_AUTORESET"),
)
"""Flags that a task's solver options set, that nothing here reads, that only report or speed up, or that are compared in another way."""
TENDON = (
    "num limited range actfrclimited actfrcrange margin stiffness stiffnesspoly frictionloss lengthspring "
    "solref_lim solimp_lim solref_fri solimp_fri length0"
)
ACTUATOR = (
    "trntype gear dyntype gaintype biastype gainprm biasprm ctrllimited forcelimited actlimited actnum actearly cranklength "
    "delay history"
)
"""Compared fields of ``mujoco.MjModel``, without their prefixes."""
SHARED = ("damping", "dampingpoly", "armature")
"""Those of joints and tendons to which actuators add."""
CONTACT = "condim friction solref solimp solmix priority margin gap contype conaffinity"
PAIR = "dim friction solref solimp margin gap solreffriction"


def _fields(model: Any, kind: str, index: int, names: str) -> Values:
    return {name: getattr(model, f"{kind}_{name}")[index] for name in names.split()}


def _place(model: Any, kind: str, index: int) -> Values:
    pos, quat = (getattr(model, f"{kind}_{name}")[index] for name in ("pos", "quat"))
    return {"pos": pos, "orientation": matrix(quat)}


def _body(model: Any, body: int) -> Values:
    values = {"parent": (("body", int(model.body_parentid[body])),)} | _place(model, "body", body)
    values |= _fields(model, "body", body, "mass gravcomp") | {"mocap": int(model.body_mocapid[body] >= 0)}
    if model.body_mass[body]:
        values |= {"inertia": inertia(model, body), "centre of mass": model.body_ipos[body]}
    return values


def _joint(model: Any, joint: int) -> Values:
    kind = word_of(mujoco.mjtJoint, model.jnt_type[joint])
    owner: Values = {"type": kind, "body": (("body", int(model.jnt_bodyid[joint])),)}
    values = owner | _fields(model, "jnt", joint, "stiffness stiffnesspoly limited actgravcomp")
    if kind != "free":
        values["pos"] = model.jnt_pos[joint]
    if kind in ("hinge", "slide"):
        coordinate = model.jnt_qposadr[joint]
        springs = {"ref": model.qpos0[coordinate], "springref": model.qpos_spring[coordinate]}
        values |= {"axis": model.jnt_axis[joint], **springs}
    if model.jnt_limited[joint]:
        values |= _fields(model, "jnt", joint, "range margin solref solimp")
    values["actuatorfrcrange"] = effort(model, joint)
    first, count = model.jnt_dofadr[joint], freedoms(model, joint)
    for name in (*SHARED, "frictionloss", "solref", "solimp"):
        word = {"solref": "solreffriction", "solimp": "solimpfriction"}.get(name, name)
        if word == name or model.dof_frictionloss[first]:
            values[word] = getattr(model, f"dof_{name}")[first : first + count]
    return values


def _geom(model: Any, geom: int) -> Values:
    kind = word_of(mujoco.mjtGeom, model.geom_type[geom])
    values: Values = {"type": kind, "body": (("body", int(model.geom_bodyid[geom])),)}
    values |= {"shape and place": extent(model, geom), "fluid": model.geom_fluid[geom]}
    if kind == "mesh":
        mesh = model.geom_dataid[geom]
        first, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
        mean = model.mesh_vert[first : first + count].astype(np.float64).mean(0)
        values |= {"vertices": count, "middle": model.geom_pos[geom] + matrix(model.geom_quat[geom]) @ mean}
    return values | (_fields(model, "geom", geom, CONTACT) if has_mask(model, geom) else {})


def _site(model: Any, site: int) -> Values:
    return {"body": (("body", int(model.site_bodyid[site])),)} | _place(model, "site", site)


def _pair(model: Any, pair: int) -> Values:
    return {"geoms": pair_ends(model, pair)} | _fields(model, "pair", pair, PAIR)


def _tendon(model: Any, tendon: int) -> Values:
    path = {"path": tendon_ends(model, tendon), "coefficients": tendon_numbers(model, tendon)}
    return path | _fields(model, "tendon", tendon, " ".join((TENDON, *SHARED)))


def _actuator(model: Any, actuator: int) -> Values:
    names = [ACTUATOR, *(SHARED if hasattr(model, "actuator_damping") else ())]  # which MuJoCo-Warp has not
    names += [
        f"{word}range" for word in ("ctrl", "force", "act") if getattr(model, f"actuator_{word}limited")[actuator]
    ]
    values: Values = {"drives": actuator_ends(model, actuator)}
    values |= _fields(model, "actuator", actuator, " ".join(names))
    values |= {name: np.trim_zeros(values[name], "b") for name in ("gear", "gainprm", "biasprm")}
    return values | (_fields(model, "actuator", actuator, "dynprm lengthrange") if values["dyntype"] else {})


def _equality(model: Any, equality: int) -> Values:
    kind = {"type": word_of(mujoco.mjtEq, model.eq_type[equality])}
    ends = {"between": equality_ends(model, equality)}
    return kind | ends | _fields(model, "eq", equality, "active0 solref solimp") | held(model, equality)


VALUES: dict[str, Callable[[Any, int], Values]] = {
    "body": _body,
    "joint": _joint,
    "geom": _geom,
    "site": _site,
    "tendon": _tendon,
    "actuator": _actuator,
    "equality": _equality,
    "pair": _pair,
}
"""Values of an element by its index, by the kind of the element."""
