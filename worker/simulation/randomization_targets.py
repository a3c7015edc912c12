"""The targets of randomisations in the model: from names and patterns to columns of arrays."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Any

import mujoco
import numpy as np

from shared_store.contract.error_text import nearest
from worker.simulation.declared_randomization import Randomize
from worker.simulation.patterns import find
from worker.simulation.randomization_kernels import CENTER, INERTIA, MASS, PAYLOAD
from worker.simulation.robot_values import UNLIMITED
from worker.simulation.robot_view import RobotView
from worker.simulation.worlds import Worlds

_FIXED, _AFFINE = int(mujoco.mjtGain.mjGAIN_FIXED), int(mujoco.mjtBias.mjBIAS_AFFINE)
_FIELDS = {
    "friction": "geom_friction",
    "armature": "dof_armature",
    "joint_damping": "dof_damping",
    "joint_friction": "dof_frictionloss",
    "joint_limits": "jnt_range",
}
_BODY_KINDS = {"mass": MASS, "center_of_mass": CENTER, "inertia": INERTIA, "payload": PAYLOAD}
LEAST_FRICTION = 1e-5
"""Least coefficient of friction in MuJoCo, which raises smaller ones to this."""


@dataclass(frozen=True)
class Change:
    """Target of one number, ``element`` x ``axis``, that an entry draws.

    Args:
        array: Name of the array: a field of mujoco_warp's model, ``opt.gravity``, Newton's ``gravity``, ``muster.NAME`` of explicit
            motors, ``bias ROBOT``, or ``bodies``.
        column: Column in a world's row of numbers, or body (Newton's).
        element: Index of the matched part.
        axis: Index of the entry's axis.
        factor: Factor of the drawn number where it is added or set.
        least: Least value of the number.
        greatest: Greatest value of the number.
        kind: Property of a body that changes.
        body_axis: Axis of that property: 0, 1, 2, or -1 for all.
    """

    array: str
    column: int
    element: int
    axis: int = 0
    factor: float = 1.0
    least: float = -math.inf
    greatest: float = math.inf
    kind: int = 0
    body_axis: int = -1


@dataclass(frozen=True)
class EntryTargets:
    """Targets of one entry: ``names`` of its parts, and ``changes`` in the same order."""

    names: tuple[str, ...]
    changes: tuple[Change, ...]


def find_target(entry: Randomize, worlds: Worlds, views: Mapping[str, RobotView]) -> EntryTargets:
    """Look up the targets of an entry.

    Args:
        entry: The declaration.
        worlds: The worlds.
        views: Robots and objects by name.

    Raises:
        ValueError: The robot is unknown, a pattern matches nothing, or a part has no such property.
    """
    if entry.what == "gravity":
        axes = [(entry.quantity.axes.index(axis), index) for index, axis in enumerate(entry.drawn_axes)]
        if entry.operation == "scale" and not entry.axes and not isinstance(entry.range, Mapping):
            axes = [(axis, 0) for axis in range(3)]
        changes = (Change(array, column, 0, index) for array in ("opt.gravity", "gravity") for column, index in axes)
        return EntryTargets(("gravity",), tuple(changes))
    if entry.robot is None:
        return _of_all_robots(entry, worlds, views)
    return _of_robot(entry, worlds, *_parts(entry, entry.robot, views))


def _of_robot(entry: Randomize, worlds: Worlds, view: RobotView, chosen: list[int]) -> EntryTargets:
    parts = entry.quantity.parts
    if parts == "bodies":
        return _bodies(entry, worlds, view, chosen)
    if parts == "geoms":
        names = [view.geom_names[geom] for geom in chosen]
        return _geoms(entry, worlds, names, [view.geoms[geom] for geom in chosen])
    if parts == "joints":
        return _joints(entry, worlds, view, chosen)
    return _actuators(entry, worlds, view, chosen)


def _of_all_robots(entry: Randomize, worlds: Worlds, views: Mapping[str, RobotView]) -> EntryTargets:
    """The targets in all robots and objects, without bodies that have no mass and joints that nothing drives."""
    parts, pattern = entry.quantity.parts, entry.pattern or "*"
    if parts == "geoms":
        one_world = _shapes_of_a_world(worlds)
        names = [worlds.model.shape_label[shape].rpartition("/")[2] for shape in one_world]
        chosen = find(names, pattern, "geom of the worlds")
        return _geoms(entry, worlds, [names[index] for index in chosen], [one_world[index] for index in chosen])
    masses, found = worlds.model.body_mass.numpy(), EntryTargets((), ())
    patterns = [pattern] if isinstance(pattern, str) else pattern
    for view in views.values():
        names = view.body_names if parts == "bodies" else view.joint_names
        matching = [index for index, name in enumerate(names) if any(fnmatchcase(name, each) for each in patterns)]
        if parts == "bodies":
            matching = [body for body in matching if masses[view.bodies[body]] > 0.0]
        elif parts == "actuators":
            matching = [joint for joint in matching if view.actuators[joint] >= 0]
        own = _of_robot(entry, worlds, view, matching)
        changes = (dataclasses.replace(each, element=each.element + len(found.names)) for each in own.changes)
        found = EntryTargets((*found.names, *own.names), (*found.changes, *changes))
    if not found.names:
        raise ValueError(f"no robot or object has {parts} that fit {pattern!r} and have a {entry.what}")
    return found


def check_patterns(entries: Mapping[str, Randomize], views: Mapping[str, RobotView]) -> None:
    """Check the robots and patterns of all entries before any world is built.

    Geoms of any robot (``robot=None``) include the ground's, so only :func:`find_target` looks for them.

    Args:
        entries: Declarations by name.
        views: Robots and objects by name.

    Raises:
        ValueError: A robot is unknown, or a pattern matches nothing.
    """
    for name, entry in entries.items():
        if entry.what == "gravity" or entry.robot is None:
            continue
        try:
            _parts(entry, entry.robot, views)
        except ValueError as error:
            raise ValueError(f"randomize.{name}: {error}") from error


def _parts(entry: Randomize, robot: str, views: Mapping[str, RobotView]) -> tuple[RobotView, list[int]]:
    """The robot of an entry, and the indices of its parts that the pattern matches."""
    if robot not in views:
        raise ValueError(f"no robot or object is called {robot!r}; {nearest(robot, views)}")
    view, pattern = views[robot], entry.pattern or "*"
    if entry.quantity.parts == "bodies":
        return view, view.find_bodies(pattern)
    if entry.quantity.parts == "geoms":
        return view, view.find_geoms(pattern)
    return view, view.find_joints(pattern)


def _shapes_of_a_world(worlds: Worlds) -> list[int]:
    """Shapes that world 0 collides with, its own and those of all worlds."""
    return sorted(int(shape) for shape in worlds.solver.mjc_geom_to_newton_shape.numpy()[0] if shape >= 0)


def _columns(newton_indices: np.ndarray, first: int = 0) -> dict[int, int]:
    """Map Newton's index in world 0 to the column in mujoco_warp's arrays."""
    return {int(index): column for column, index in enumerate(newton_indices) if index >= first}


def body_column(worlds: Worlds, body: int) -> int:
    """Column of Newton's body in mujoco_warp's arrays."""
    return _columns(worlds.solver.mjc_body_to_newton.numpy()[0])[body]


def _bodies(entry: Randomize, worlds: Worlds, view: RobotView, chosen: list[int]) -> EntryTargets:
    masses = worlds.model.body_mass.numpy()
    axes = [entry.quantity.axes.index(axis) for axis in entry.drawn_axes] or [-1]
    for index in chosen:
        body, name = view.bodies[index], view.body_names[index]
        if masses[body] <= 0.0:
            raise ValueError(f"body {name} of {view.name} has no mass; give the pattern of bodies that have one")
    changes = (
        Change("bodies", view.bodies[index], element, number, kind=_BODY_KINDS[entry.what], body_axis=axis)
        for element, index in enumerate(chosen)
        for number, axis in enumerate(axes)
    )
    return EntryTargets(tuple(view.body_names[index] for index in chosen), tuple(changes))


def _geoms(entry: Randomize, worlds: Worlds, names: list[str], shapes: list[int]) -> EntryTargets:
    columns = _columns(worlds.solver.mjc_geom_to_newton_shape.numpy()[0])
    axes = [(entry.quantity.axes.index(axis), number) for number, axis in enumerate(entry.drawn_axes)]
    if entry.what == "contact_friction":
        axes = [(axis, 0) for axis in range(3)]
    own_shapes = [(name, columns[shape]) for name, shape in zip(names, shapes, strict=True) if shape in columns]
    if not own_shapes:
        raise ValueError(f"geoms {', '.join(names)} touch nothing, so they have no friction; choose geoms that collide")
    changes = (
        Change("geom_friction", 3 * geom + axis, element, number, least=LEAST_FRICTION)
        for element, (_, geom) in enumerate(own_shapes)
        for axis, number in axes
    )
    return EntryTargets(tuple(name for name, _ in own_shapes), tuple(changes))


def _joints(entry: Randomize, worlds: Worlds, view: RobotView, chosen: list[int]) -> EntryTargets:
    names = tuple(view.joint_names[joint] for joint in chosen)
    if entry.what == "encoder_bias":
        return EntryTargets(
            names, tuple(Change(f"bias {view.name}", joint, index) for index, joint in enumerate(chosen))
        )
    solver, model = worlds.solver, worlds.solver.mj_model
    dofs = _columns(solver.mjc_dof_to_newton_dof.numpy()[0])
    changes = []
    for element, joint in enumerate(chosen):
        dof = dofs[view.dofs[joint]]
        if entry.what != "joint_limits":
            changes.append(Change(_FIELDS[entry.what], dof, element, least=0.0))
            continue
        column = int(model.dof_jntid[dof])
        if not model.jnt_limited[column]:
            raise ValueError(f"joint {names[element]} of {view.name} has no limits; give it a range in the file")
        for number, axis in enumerate(entry.drawn_axes):
            side = entry.quantity.axes.index(axis)
            changes.append(Change("jnt_range", 2 * column + side, element, number))
    return EntryTargets(names, tuple(changes))


def _actuators(entry: Randomize, worlds: Worlds, view: RobotView, chosen: list[int]) -> EntryTargets:
    sources = worlds.solver.mjc_actuator_to_newton_idx
    columns = {int(source): column for column, source in enumerate([] if sources is None else sources.numpy())}
    names = tuple(view.joint_names[joint] for joint in chosen)
    changes: list[Change] = []
    for element, joint in enumerate(chosen):
        where = f"joint {names[element]} of {view.name}"
        if view.actuators[joint] < 0:
            driven = [name for name, column in zip(view.joint_names, view.actuators, strict=True) if column >= 0]
            raise ValueError(f"{where} has no actuator; there are those of {', '.join(driven) or 'no joint'}")
        source = view.actuators[joint]
        own = _of_explicit_motor(entry.what, worlds, source, element)
        changes += own
        if (
            not own or entry.what == "effort_limit"
        ):  # the force of such a motor is limited both when it is computed and when it acts
            changes += _of_actuator(entry.what, worlds, columns[source], element, where)
    return EntryTargets(names, tuple(changes))


def _of_explicit_motor(what: str, worlds: Worlds, source: int, element: int) -> list[Change]:
    """The numbers of an explicit motor; empty for MuJoCo's own actuators, or where the motor has no such number."""
    motors: Any = getattr(worlds.model, "muster", None)
    if motors is None or what == "motor_strength" or not motors.explicit.numpy()[source]:
        return []
    if not math.isfinite(getattr(motors, what).numpy()[source]):
        return []
    return [Change(f"muster.{what}", source, element, least=0.0)]


def _of_actuator(what: str, worlds: Worlds, actuator: int, element: int, where: str) -> list[Change]:
    """The numbers of one actuator. Its force is gain x control + bias x (1, length, velocity), ten numbers each in the model."""
    model = worlds.solver.mj_model
    if what == "effort_limit":
        return _effort_limits(model, actuator, element, where)
    first = 10 * actuator
    bias = model.actuator_biasprm[actuator]
    affine = int(model.actuator_biastype[actuator]) == _AFFINE
    if int(model.actuator_gaintype[actuator]) != _FIXED:
        raise ValueError(f"the actuator of {where} is a muscle or the like, which has no {what}; choose others")
    if what == "motor_strength":
        changes = [Change("actuator_gainprm", first, element)]
        return changes + [Change("actuator_biasprm", first + index, element) for index in range(3 if affine else 0)]
    is_position = affine and bias[1] != 0.0
    is_velocity = affine and not is_position and bias[2] != 0.0
    if what == "stiffness" and is_position:
        return [
            Change("actuator_gainprm", first, element, least=0.0),
            Change("actuator_biasprm", first + 1, element, factor=-1.0, greatest=0.0),
        ]
    if what == "damping" and (is_position or is_velocity):
        damping = Change("actuator_biasprm", first + 2, element, factor=-1.0, greatest=0.0)
        return [damping, Change("actuator_gainprm", first, element, least=0.0)] if is_velocity else [damping]
    kind = "velocity actuator" if is_velocity else "motor"
    raise ValueError(
        f"the actuator of {where} is a {kind}, which has no {what}; randomize its motor_strength, or choose others"
    )


def _effort_limits(model: mujoco.MjModel, actuator: int, element: int, where: str) -> list[Change]:
    """Force limits of the actuator and of the joint, whichever exist."""
    changes = []
    if model.actuator_forcelimited[actuator]:
        gear = abs(float(model.actuator_gear[actuator, 0])) or 1.0
        changes += [
            Change("actuator_forcerange", 2 * actuator, element, factor=-1.0 / gear, greatest=0.0),
            Change("actuator_forcerange", 2 * actuator + 1, element, factor=1.0 / gear, least=0.0),
        ]
    joint = int(model.actuator_trnid[actuator, 0])
    if model.jnt_actfrclimited[joint] and model.jnt_actfrcrange[joint, 1] < UNLIMITED:
        changes += [
            Change("jnt_actfrcrange", 2 * joint, element, factor=-1.0, greatest=0.0),
            Change("jnt_actfrcrange", 2 * joint + 1, element, factor=1.0, least=0.0),
        ]
    if not changes:
        raise ValueError(
            f"the force of {where}'s actuator is not limited; give it a forcerange, or randomize its motor_strength"
        )
    return changes
