"""Reads a robot's file with Newton's importer, judged by MuJoCo's compiler.

Newton reads the file as it is. Where the robot that it builds differs from MuJoCo's compiled model of the same file, the robot is
built from the compiled model instead; what differs even then is refused by name. USD's own schema judges a USD file, which MuJoCo
does not compile.
"""

from __future__ import annotations

import fnmatch
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import newton
import warp as wp
from newton.solvers import SolverMuJoCo

from shared_store.contract.error_text import counted
from shared_store.contract.policy import RobotModel
from worker.settings.accepted_changes import CHANGED_ROBOTS
from worker.simulation import actuators as actuation
from worker.simulation import robot_comparison as robot_judge
from worker.simulation import robot_files, robot_mjcf, robot_reference, robot_values
from worker.simulation.robot_comparison import Comparison, RobotDifference
from worker.simulation.robot_elements import empty_builder, keep_inertias, short
from worker.simulation.robot_files import RobotFile
from worker.simulation.robot_identity import identity
from worker.simulation.robot_reference import ReferenceModel
from worker.simulation.robot_values import UNLIMITED
from worker.simulation.robot_view import RobotView, actuator_value, actuators_of_dofs
from worker.simulation.solver import mark_sliders

if TYPE_CHECKING:
    from worker.simulation.robot import Robot

RAW_SOLREF = 1
"""Newton's mode of a joint that passes the ``solref`` of its limit to MuJoCo unchanged."""
REMEDIES = {
    **dict.fromkeys(
        ("delay", "history"), "Declare the delay in the task, in physics steps: PositionActuator(..., delay=STEPS)"
    ),
    "dampingpoly": "Give damping one number",
    "stiffnesspoly": "Give stiffness one number",
    "fluid": "Leave out fluidshape",
    "actuatorfrcrange": "Make it symmetric, or give the actuator a forcerange instead",
    "plugin": "Leave the plugin out, or replace it by elements of MJCF that need none",
    "flexible body": "Leave out the flexible body",
    "anchor2": "Let both sites of the equality be at one place in the first pose of the file",
    "axes of inertia": "Give the body an <inertial> of three different moments, on whose axes the medium's drag acts",
    "greatest force of actuators": "Newton limits the force on a joint: choose smaller gears or gains",
    "acceleration in the same state": "No single value shows why: leave out parts of the file until it is read",
}
"""What to do about a value that Newton can't hold, by its field."""
AS_IMPORTED = "loaded as Newton's importer reads it, since changed robots are accepted: {}"
"""Note of a robot that would be refused."""
FILE = "file"
"""Stands for an element where Newton's importer can't read the file at all."""
SOLREF_DEFAULT = (0.02, 1.0)
"""MuJoCo's default ``solref``: time constant [s] and damping ratio."""


@dataclass(frozen=True)
class Reading:
    """A robot as its file says.

    Attributes:
        builder: Holds the robot alone, with the actuators of its file; the controls are their inputs.
        reference: MuJoCo's compiled model of the file; None for a USD file.
        corrected: What Newton's importer had read otherwise, and is right now.
        notes: What else a user should know of it, one sentence each: accepted differences, for one.
        identity: By which a policy knows the robot again.
    """

    builder: newton.ModelBuilder
    reference: ReferenceModel | None
    corrected: tuple[RobotDifference, ...]
    notes: tuple[str, ...]
    identity: RobotModel

    def lines(self) -> list[str]:
        """What a user should know of the robot, one sentence each."""
        if not self.corrected:
            return list(self.notes)
        first = self.corrected[0]
        otherwise = f"differs in {counted(len(self.corrected), 'value')}, first in {first.field} of {first.element}"
        why = "can't read it" if first.element == FILE else otherwise
        judge = "MuJoCo reads" if self.reference else "USD's schema reads"
        return [f"built as {judge} its file; Newton's importer {why}", *self.notes]


def shown(file: str | Path) -> str:
    """A file's name, for errors."""
    text = str(file)
    return "its XML" if robot_files.is_xml(text) else text


class AnotherRobot(ValueError):
    """A robot can't be held as its file says.

    Args:
        file: The file's name.
        differences: What would differ.
        accept: Patterns of differences that were accepted, and matched others, or none.
    """

    def __init__(self, file: str, differences: Sequence[RobotDifference], accept: Sequence[str] = ()) -> None:
        self.differences = tuple(differences)
        first = differences[0]
        more = f", and {len(differences) - 1} more" if len(differences) > 1 else ""
        pattern = f"{first.element}: {first.field}"
        super().__init__(
            f"{file} would be another robot here: {first}{more}. {REMEDIES.get(first.field, 'Change the file')}, or accept the "
            f"difference: Robot(..., accept=({pattern!r},)). For a run that was trained on it: --accept-changed-robot"
            + (f". All of them: muster robot {file} --compare" if more else "")
            + (f". It does not match what is accepted: {', '.join(map(repr, accept))}" if accept else "")
        )


def read(robot: Robot) -> Reading:
    """Read a robot's file.

    Raises:
        AnotherRobot: The robot would be another one here.
        ValueError: The file or a mesh is missing or can't be read, or MuJoCo refuses it.
    """
    file, name = robot_files.read(robot.file), shown(robot.file)
    reference, is_readable = None, True
    if file.format == "usd":
        from worker.simulation import robot_usd  # USD's library takes a while

        builder = _imported(robot, file)
        found, corrected = robot_usd.judge(file.source, builder, robot.ignore, name, robot.accept)
        notes = list(found.notes)
    else:
        reference = robot_reference.compile_file(file, robot, name)
        notes = list(reference.notes)
        try:
            builder = _imported(robot, file)
            found = robot_judge.compare(reference.model, builder, options=robot.file_options, accept=robot.accept)
            corrected = found.differences
        except Exception as error:  # whatever an importer stumbles over, MuJoCo's model is there
            corrected = (RobotDifference(FILE, "import by Newton", f"impossible ({_line(error)})", "possible"),)
            found, is_readable = Comparison(corrected, (), {}), False
        else:
            if (
                file.format == "urdf" and corrected
            ):  # limits as stiff as MuJoCo's: Newton's own are springs that hardly damp
                _set_all_dofs(builder, "solreflimit_mode", RAW_SOLREF)
                _set_all_dofs(builder, "solreflimit", wp.vec2(*SOLREF_DEFAULT))
            found = _amended(robot, builder, reference.model, found)
        if found.differences:
            builder = _imported(
                replace(robot, visuals=True, fixed=None), _rewritten(file, reference.model, robot, name)
            )
            found = robot_judge.compare(reference.model, builder, options=robot.file_options, accept=robot.accept)
            found = _amended(robot, builder, reference.model, found)
            if reference.looks:
                notes.append(f"pictures lack the {reference.looks} of the file, since MuJoCo's compiled model has none")
        notes += found.notes
    if found.differences:
        refusal = AnotherRobot(name, found.differences, robot.accept)
        if not CHANGED_ROBOTS.get() or not is_readable:
            raise refusal
        builder = _imported(robot, file)  # as the training had it
        notes = [*(reference.notes if reference else ()), AS_IMPORTED.format(refusal)]
        if reference:
            return Reading(builder, reference, corrected, tuple(notes), identity(builder, None))
    mark_sliders(builder, found.sliders)
    notes += [f"accepted: {each}" for each in found.accepted]
    for pattern in robot.accept:
        if not any(robot_judge.matches(each, (pattern,)) for each in found.accepted):
            notes.append(f"accept={pattern!r} matches no difference from the file")
    model = reference.model if reference else None
    own = identity(builder, model, options=robot.file_options, accepted=found.accepted)
    return Reading(builder, reference, corrected, tuple(notes), own)


def _amended(robot: Robot, builder: newton.ModelBuilder, model: Any, found: Comparison) -> Comparison:
    """Correct what the importers don't read or can't say, and compare once more.

    They read whether there is gravity, but not which, and round moments of inertia; models enlarge small ones.
    """
    if not found.differences:
        return found
    if robot.file_options:
        builder.gravity = wp.vec3(*robot_values.gravity(model))
    for body, index in found.bodies.items():
        builder.body_mass[index] = float(model.body_mass[body])
        builder.body_com[index] = wp.vec3(*model.body_ipos[body])
        builder.body_inertia[index] = wp.mat33(*robot_values.inertia(model, body).ravel())
    keep_inertias(builder)
    return robot_judge.compare(model, builder, options=robot.file_options, accept=robot.accept)


def _imported(robot: Robot, file: RobotFile) -> newton.ModelBuilder:
    """The robot as Newton's importer builds it."""
    builder, ignored = empty_builder(), [fnmatch.translate(pattern) for pattern in robot.ignore]
    floating = None if robot.fixed is None else not robot.fixed
    try:
        with robot_files.quiet():  # what the importer leaves out or changes is found by comparison
            if file.format == "mjcf":
                builder.add_mjcf(
                    file.source,
                    floating=floating,
                    ctrl_direct=True,
                    ignore_names=ignored,
                    parse_visuals=robot.visuals,
                    parse_mujoco_options=robot.file_options,
                )
            elif file.format == "urdf":
                builder.add_urdf(file.source, floating=floating)
            else:
                from worker.simulation import robot_usd

                builder.add_usd(
                    file.source,
                    floating=floating,
                    ignore_paths=[f".*/{pattern}" for pattern in ignored],
                    load_visual_shapes=robot.visuals,
                    only_load_enabled_rigid_bodies=True,
                    schema_resolvers=list(robot_usd.SCHEMAS),
                    parse_mujoco_options=robot.file_options,
                )
    except Exception as error:
        raise ValueError(f"{shown(robot.file)} can't be read: {_line(error)}") from error
    if not builder.body_count:
        raise ValueError(f"{shown(robot.file)} has no body that could be a robot's")
    labels: Any = builder.custom_attributes["mujoco:joint_dof_label"]
    labels.values = labels.values or {}
    for joint, label in enumerate(builder.joint_label):
        for index, name in enumerate(file.hinges.get(short(label), ())):
            labels.values[builder.joint_qd_start[joint] + index] = f"{label.rpartition('/')[0]}/{name}"
    _take_controls(builder)
    return builder


def _line(error: Exception) -> str:
    """An error in one line, of OpenUSD's only what they say."""
    text = " ".join(str(error).split()) or type(error).__name__
    return "; ".join(re.findall(r" : '(.+?)'(?= Error in '|$)", text)) or text


def _rewritten(file: RobotFile, model: Any, robot: Robot, shown: str) -> RobotFile:
    try:
        text = robot_mjcf.write(model, named=robot_files.named_options(file), visuals=robot.visuals)
    except ValueError as error:
        raise ValueError(f"{shown}: {error}") from error
    return RobotFile(text, "mjcf")


def _set_all_dofs(builder: newton.ModelBuilder, name: str, value: Any) -> None:
    attribute: Any = builder.custom_attributes[f"mujoco:{name}"]
    attribute.values = dict.fromkeys(range(builder.joint_dof_count), value)


def _take_controls(own: newton.ModelBuilder) -> None:
    """Let every actuator of the file follow the controls, and none Newton's joint targets, which a task does not write.

    A drive of a USD file becomes an actuator, unless its joint has one beside it.
    """
    drives = {
        dof: (own.joint_target_ke[dof], own.joint_target_kd[dof], own.joint_effort_limit[dof])
        for dof, mode in enumerate(own.joint_target_mode)
        if mode != int(newton.JointTargetMode.NONE)
    }
    for dof in range(own.joint_dof_count):
        own.joint_target_mode[dof] = int(newton.JointTargetMode.NONE)
        own.joint_target_ke[dof] = own.joint_target_kd[dof] = 0.0
    rows: Any = own.custom_attributes["mujoco:actuator_trnid"].values
    labels: Any = own.custom_attributes["mujoco:joint_dof_label"].values or {}
    sources: Any = own.custom_attributes["mujoco:ctrl_source"].values
    dofs = {label: dof for dof, label in labels.items()}
    for actuator, target in enumerate(rows or ()):
        sources[actuator] = int(SolverMuJoCo.CtrlSource.CTRL_DIRECT)
        label = actuator_value(own, "actuator_target_label", actuator)
        # a USD file's: the label would not say of which of two equal robots
        if (target is None or int(target[0]) < 0) and label in dofs:
            rows[actuator] = wp.vec2i(dofs[label], 0)
    actuation.register(own)
    for name, (_, default) in actuation.MOTOR_ATTRIBUTES.items():
        own.custom_attributes[f"muster:{name}"].values = [default] * len(rows or ())
    _add_drives(own, drives)


def _add_drives(own: newton.ModelBuilder, drives: Mapping[int, tuple[float, float, float]]) -> None:
    """Make actuators of drives: by degree of freedom, stiffness, damping and greatest force, in the joint's units."""
    view, driven = RobotView(own, ""), actuators_of_dofs(own)
    for name, dof in zip(view.joint_names, view.dofs, strict=True):
        stiffness, damping, limit = drives.get(dof, (0.0, 0.0, 0.0))
        limits: Any = {"effort_limit": limit} if 0.0 < limit < UNLIMITED else {}
        actuator: actuation.Actuator = actuation.PositionActuator(name, stiffness, damping, **limits)
        if not stiffness:
            actuator = actuation.VelocityActuator(name, damping, **limits)
        if dof not in driven and stiffness + damping > 0.0:
            actuation.add(own, [name], [dof], [actuator], "robot")
