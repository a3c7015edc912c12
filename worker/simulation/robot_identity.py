"""The identity of a robot's compiled model, by which a policy knows again the robot it was trained on."""

from __future__ import annotations

import hashlib
import json
from collections import defaultdict
from collections.abc import Sequence
from typing import Any

import mujoco
import newton
import numpy as np

from shared_store.contract.policy import RobotModel
from worker.simulation.robot_comparison import RobotDifference
from worker.simulation.robot_elements import Ends, count_of, kind_of, name_of, short, word_of
from worker.simulation.robot_fields import ELSEWHERE, ENDS, VALUES, Values
from worker.simulation.robot_values import gravity

_IMPORTED = (
    "body_mass body_com body_inertia joint_type joint_parent joint_child joint_X_p joint_X_c joint_axis joint_limit_lower "
    "joint_limit_upper joint_armature joint_friction joint_damping shape_type shape_body shape_scale shape_transform"
)
"""Arrays of Newton's builder that say what a robot is, where it holds another one than the file, or MuJoCo doesn't compile the file."""
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
    """The values of each element of a compiled model, in the model's order; what it connects, by names."""
    found = {}
    for kind, values in VALUES.items():
        for index in range(kind == "body", count_of(model, kind)):  # a body 0 is the world
            name = f"contact pair {index}" if kind == "pair" else f"{kind} {name_of(model, kind_of(kind), index)}"
            own = values(model, index)
            found[name] = {key: _names(model, value) if key in ENDS else value for key, value in own.items()}
    excluded = ([int(signature) >> 16, int(signature) & 0xFFFF] for signature in model.exclude_signature)
    return found | {"model": {"exclude": _names(model, tuple(("body", body) for pair in excluded for body in pair))}}


def _names(model: Any, ends: Ends) -> str:
    """The names of what an element connects."""
    return ", ".join(name_of(model, kind_of(kind), index) for kind, index in ends if index >= 0)


def _options(builder: newton.ModelBuilder, model: Any) -> Values:
    """The file's options; an integrator only where the file names one, since the worlds' default holds otherwise."""
    values = {"gravity": gravity(model)} | {name: getattr(model.opt, name) for name in OPTION.split()}
    for kind, name in ((mujoco.mjtDisableBit, "disableflags"), (mujoco.mjtEnableBit, "enableflags")):
        flags = [
            bit for bit in kind.__members__.values() if not bit.name.startswith("mjN") and bit.name not in ELSEWHERE
        ]
        values[name] = " ".join(word_of(kind, bit) for bit in flags if int(values[name]) & int(bit))
    return values | {"integrator": (builder.custom_attributes["mujoco:integrator"].values or [None])[0]}


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
