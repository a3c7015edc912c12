"""The identity of a robot's compiled model, by which a policy knows again the robot it was trained on."""

from __future__ import annotations

import hashlib
import json
from collections import defaultdict
from collections.abc import Callable, Sequence
from typing import Any

import mujoco
import newton
import numpy as np

from shared_store.contract.policy import RobotModel
from worker.simulation.robot_comparison import ACTUATOR, ELSEWHERE, SHARED, TENDON, RobotDifference
from worker.simulation.robot_elements import (
    Ends,
    actuator_ends,
    count_of,
    equality_ends,
    held,
    kind_of,
    matrix,
    name_of,
    pair_ends,
    short,
    tendon_ends,
    tendon_numbers,
    word_of,
)
from worker.simulation.robot_values import effort, extent, freedoms, gravity, has_mask, inertia

Values = dict[str, Any]
"""Values of one element by their names: numbers, arrays or words."""
_IMPORTED = (
    "body_mass body_com body_inertia joint_type joint_parent joint_child joint_X_p joint_X_c joint_axis joint_limit_lower "
    "joint_limit_upper joint_armature joint_friction joint_damping shape_type shape_body shape_scale shape_transform"
)
"""Arrays of Newton's builder that say what a robot is, where it holds another one than the file, or MuJoCo doesn't compile the file."""
CONTACT = "condim friction solref solimp solmix priority margin gap contype conaffinity"
PAIR = "dim friction solref solimp margin gap solreffriction"
OPTION = (
    "wind density viscosity impratio cone disableactuator solver iterations ls_iterations tolerance ls_tolerance "
    "disableflags enableflags"
)
"""Fields of ``mujoco.MjModel`` beside those that the judge names, without their prefixes."""
DIGITS = 5
"""Significant digits of a number that count."""
RESIDUE = 1e-9
"""Share of the greatest number of a kind up to which a number is what rounding left of 0, which differs between processors."""
MOST = 50
"""Of more numbers than these, an identity holds a digest."""


def identity(
    builder: newton.ModelBuilder, reference: Any, *, options: bool = True, accepted: Sequence[RobotDifference] = ()
) -> RobotModel:
    """Identify a robot, without a name.

    It holds what the judge compares, whatever a task sets itself: neither its time step nor its solver options count.

    Args:
        builder: The robot as its file says, alone.
        reference: The file's compiled model, ``mujoco.MjModel``; None for a USD file.
        options: Whether the file's solver options apply, and so count.
        accepted: What the builder has otherwise than the file.
    """
    if reference is None:
        arrays = {field: getattr(builder, field) for field in _IMPORTED.split()}
        drives = {
            field: builder.custom_attributes[f"mujoco:actuator_{field}"].values or []
            for field in ("gainprm", "biasprm")
        }
        labelled = zip(builder.body_label, builder.body_mass, strict=True)
        found: dict[str, Values] = {f"body {short(label)}": {"mass": own} for label, own in labelled}
        hidden = {"model": {field: _flat(values) for field, values in {**arrays, **drives}.items()}}
        joints, actuators, mass = builder.joint_count, len(drives["gainprm"]), float(sum(builder.body_mass))
    else:
        found, hidden = _elements(reference), {}
        if options:
            found["option"] = _options(builder, reference)
        joints, actuators, mass = reference.njnt, reference.nu, float(reference.body_mass.sum())
    for each in accepted:
        found.setdefault(each.element, {})[each.field] = each.built
    elements = _plain(found)
    digest = hashlib.sha256(json.dumps([elements, _plain(hidden)]).encode()).hexdigest()
    return RobotModel("", digest, float(f"{mass:.6g}"), int(joints), int(actuators), elements)


def _elements(model: Any) -> dict[str, Values]:
    """What is compared of each element of a compiled model, in the model's order."""
    found = {
        f"{kind} {name_of(model, kind_of(kind), index)}": values(model, index)
        for kind, values in _VALUES.items()
        for index in range(kind == "body", count_of(model, kind))  # a body 0 is the world
    }
    found |= {f"contact pair {pair}": _pair(model, pair) for pair in range(model.npair)}
    excluded = ([int(signature) >> 16, int(signature) & 0xFFFF] for signature in model.exclude_signature)
    return found | {"model": {"exclude": _names(model, tuple(("body", body) for pair in excluded for body in pair))}}


def _fields(model: Any, kind: str, index: int, names: str) -> Values:
    return {name: getattr(model, f"{kind}_{name}")[index] for name in names.split()}


def _names(model: Any, ends: Ends) -> str:
    """The names of what an element connects."""
    return ", ".join(name_of(model, kind_of(kind), index) for kind, index in ends if index >= 0)


def _place(model: Any, kind: str, index: int) -> Values:
    pos, quat = (getattr(model, f"{kind}_{name}")[index] for name in ("pos", "quat"))
    return {"pos": pos, "orientation": matrix(quat)}


def _body(model: Any, body: int) -> Values:
    values = {"parent": _names(model, (("body", int(model.body_parentid[body])),))} | _place(model, "body", body)
    values |= _fields(model, "body", body, "mass gravcomp") | {"mocap": int(model.body_mocapid[body] >= 0)}
    if model.body_mass[body]:
        values |= {"inertia": inertia(model, body), "centre of mass": model.body_ipos[body]}
    return values


def _joint(model: Any, joint: int) -> Values:
    kind = word_of(mujoco.mjtJoint, model.jnt_type[joint])
    body: Values = {"type": kind, "body": _names(model, (("body", int(model.jnt_bodyid[joint])),))}
    values = body | _fields(model, "jnt", joint, "stiffness stiffnesspoly limited actgravcomp")
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
    values = {"type": kind, "body": _names(model, (("body", int(model.geom_bodyid[geom])),))}
    values |= {"shape and place": extent(model, geom), "fluid": model.geom_fluid[geom]}
    if kind == "mesh":
        mesh = model.geom_dataid[geom]
        first, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
        mean = model.mesh_vert[first : first + count].astype(np.float64).mean(0)
        values |= {"vertices": count, "middle": model.geom_pos[geom] + matrix(model.geom_quat[geom]) @ mean}
    return values | (_fields(model, "geom", geom, CONTACT) if has_mask(model, geom) else {})


def _site(model: Any, site: int) -> Values:
    return {"body": _names(model, (("body", int(model.site_bodyid[site])),))} | _place(model, "site", site)


def _pair(model: Any, pair: int) -> Values:
    return {"geoms": _names(model, pair_ends(model, pair))} | _fields(model, "pair", pair, PAIR)


def _tendon(model: Any, tendon: int) -> Values:
    path = {"path": _names(model, tendon_ends(model, tendon)), "coefficients": tendon_numbers(model, tendon)}
    return path | _fields(model, "tendon", tendon, " ".join((TENDON, *SHARED)))


def _actuator(model: Any, actuator: int) -> Values:
    limits = " ".join(f"{word}range" for word in ("ctrl", "force", "act") if _is_limited(model, word, actuator))
    values = {"drives": _names(model, actuator_ends(model, actuator))}
    values |= _fields(model, "actuator", actuator, " ".join((ACTUATOR, *SHARED, limits)))
    values |= {name: np.trim_zeros(values[name], "b") for name in ("gear", "gainprm", "biasprm")}
    return values | (_fields(model, "actuator", actuator, "dynprm lengthrange") if values["dyntype"] else {})


def _is_limited(model: Any, word: str, actuator: int) -> bool:
    return bool(getattr(model, f"actuator_{word}limited")[actuator])


def _equality(model: Any, equality: int) -> Values:
    kind = {"type": word_of(mujoco.mjtEq, model.eq_type[equality])}
    ends = {"between": _names(model, equality_ends(model, equality))}
    return kind | ends | _fields(model, "eq", equality, "active0 solref solimp") | held(model, equality)


def _options(builder: newton.ModelBuilder, model: Any) -> Values:
    """The file's options; an integrator only where the file names one, since the worlds' default holds otherwise."""
    values = {"gravity": gravity(model)} | {name: getattr(model.opt, name) for name in OPTION.split()}
    for kind, name in ((mujoco.mjtDisableBit, "disableflags"), (mujoco.mjtEnableBit, "enableflags")):
        flags = [
            bit for bit in kind.__members__.values() if not bit.name.startswith("mjN") and bit.name not in ELSEWHERE
        ]
        values[name] = " ".join(word_of(kind, bit) for bit in flags if int(values[name]) & int(bit))
    return values | {"integrator": (builder.custom_attributes["mujoco:integrator"].values or [None])[0]}


_VALUES: dict[str, Callable[[Any, int], Values]] = {
    "body": _body,
    "joint": _joint,
    "geom": _geom,
    "site": _site,
    "tendon": _tendon,
    "actuator": _actuator,
    "equality": _equality,
}


def _flat(values: Any) -> Any:
    rows = [list(each) if hasattr(each, "__len__") else each for each in values]
    return np.array(rows, np.float64).ravel()


def _plain(elements: dict[str, Values]) -> dict[str, dict[str, float | str]]:
    """As :attr:`RobotModel.elements`: numbers and words, without zeros."""
    greatest: defaultdict[tuple[str, str], float] = defaultdict(float)
    for element, values in elements.items():
        for name, value in values.items():
            if not isinstance(value, str | None):
                key = element.partition(" ")[0], name
                greatest[key] = max(greatest[key], float(np.abs(np.asarray(value, np.float64)).max(initial=0.0)))
    found: dict[str, dict[str, float | str]] = {}
    for element, values in elements.items():
        kind = element.partition(" ")[0]
        plain = {name: _rounded(value, RESIDUE * greatest[kind, name]) for name, value in values.items()}
        found[element] = {name: value for name, value in plain.items() if value}
    return found


def _rounded(value: Any, residue: float) -> float | str:
    """A number or a word; several numbers, or the digest of many, as one word, which is empty where all of them are 0."""
    if isinstance(value, str | None):
        return value or ""
    numbers = np.asarray(value, np.float64).ravel()
    numbers = np.where(np.abs(numbers) <= residue, 0.0, numbers)
    words = [f"{number:.{DIGITS}g}" for number in numbers]
    if not numbers.any():
        return ""
    if len(words) == 1:
        return float(words[0])
    text = " ".join(words)
    return text if len(words) <= MOST else f"{len(words)} numbers ({hashlib.sha256(text.encode()).hexdigest()[:12]})"
