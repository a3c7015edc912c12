"""Targets of action terms: joints, with one action each, or a frame of a robot, by inverse kinematics."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from worker.simulation.actuators import Input
from worker.simulation.robot_view import RobotView
from worker.simulation.sensors.differential_ik import DifferentialIK
from worker.tasks.compile.binding import Bound
from worker.tasks.declare.declaration import Action
from worker.tasks.declare.term_needs import needs_of


def frame_of(bound: Bound, sensors: Mapping[str, Any]) -> DifferentialIK | None:
    """The frame that an action term moves; None: the term drives joints."""
    found = next(_frames(bound, sensors), None)
    return sensors[found] if found and bound.takes("index") else None


def _frames(bound: Bound, sensors: Mapping[str, Any]) -> Iterator[str]:
    """Names of a term's inverse kinematics."""
    read_sensors = {
        variable.removeprefix("sensor_") for variable in bound.arguments.values() if variable.startswith("sensor_")
    }
    yield from (name for name, sensor in sensors.items() if name in read_sensors and isinstance(sensor, DifferentialIK))


TAKING: Mapping[Input, tuple[str, str, str]] = {
    "effort": ("an effort", "terms.effort", "an EffortActuator"),
    "position": ("a position", "terms.position_target", "a PositionActuator"),
    "velocity": ("a velocity", "terms.velocity_target", "a VelocityActuator"),
}
"""Each kind of input in words, a function that writes it, and an actuator that takes it."""


def check_action(bound: Bound, views: Mapping[str, RobotView], sensors: Mapping[str, Any]) -> Input:
    """Refuse a term that drives neither joints nor a frame, or joints without an actuator that takes what it writes.

    The names of a frame's columns are filled in.

    Returns:
        What the term writes to actuators: ``"effort"``, ``"position"`` or ``"velocity"``.

    Raises:
        ValueError: In one line with its place.
    """
    place, term = bound.place, bound.term
    frame = frame_of(bound, sensors)
    if bound.signature is None or not bound.takes("value") or not (bound.takes("joint") or frame):
        raise ValueError(
            f"{place}: {term.function_name} needs the parameters joint: int and value: float; "
            "or index: int, value: float and one of the type IkArrays"
        )
    if frame:
        columns = frame.rows(views)
        bound.element_names = columns[: len(bound.elements or [])]  # by number where size= says how many
        if frame.absolute and len(bound.element_names) < len(columns):
            raise ValueError(
                f"{place}: size is {len(bound.element_names)}, and an absolute target has {len(columns)} columns; leave size= out"
            )
        return "position"
    view = views[term.robot]
    lacking = [joint for joint in bound.elements or [] if view.actuators[joint] < 0]
    if lacking:
        raise ValueError(
            f"{place}: joint {view.joint_names[lacking[0]]} has no actuator; give the robot one, or leave the joint out of joints="
        )
    return _input_of(bound, view)


def _input_of(bound: Bound, view: RobotView) -> Input:
    """What a term of joints writes to their actuators. Raises ValueError if it contradicts itself, or an actuator takes another input."""
    place, term, joints = bound.place, bound.term, bound.elements or []
    assert isinstance(term, Action)
    known = needs_of(term.function).kind
    if term.kind and known and term.kind != known:
        raise ValueError(
            f"{place}: kind is {term.kind!r}, and {term.function_name} writes {TAKING[known][0]}; leave kind= out"
        )
    taken = sorted({each for joint in joints if (each := view.inputs[joint])})
    if len(taken) > 1 and not (term.kind or known):
        raise ValueError(
            f"{place}: the actuators of its joints take {' and '.join(TAKING[each][0] for each in taken)}; "
            "declare an action for each, with joints="
        )
    kind = term.kind or known or (taken[0] if taken else "effort")
    for joint in joints:
        takes = view.inputs[joint]
        if takes and takes != kind:
            (written, _, actuator), (taking, function, _) = TAKING[kind], TAKING[takes]
            raise ValueError(
                f"{place}: {term.function_name} writes {written}, and the actuator of joint {view.joint_names[joint]} takes {taking}; "
                f"use {function}, or give the joint {actuator}"
            )
    return kind


def check_driven(acting: Sequence[Bound], views: Mapping[str, RobotView], sensors: Mapping[str, Any]) -> None:
    """Refuse two actions for one joint or frame, and inverse kinematics that no action uses.

    Args:
        acting: The terms of the actions.
        views: The robots and objects by name.
        sensors: The sensors as declared, by name.

    Raises:
        ValueError: In one line.
    """
    names = [name for bound in acting for name in bound.element_names]
    if doubled := next((name for name in names if names.count(name) > 1), None):
        what = "joint" if any(bound.takes("joint") and doubled in bound.element_names for bound in acting) else "column"
        raise ValueError(f"actions: {what} {doubled} is driven by two terms; each {what} has one action")
    driven = {(bound.term.robot, joint) for bound in acting if bound.takes("joint") for joint in bound.elements or ()}
    moved_frames = {name for bound in acting for name in _frames(bound, sensors)}
    for name, sensor in sensors.items():
        if not isinstance(sensor, DifferentialIK):
            continue
        if name not in moved_frames:
            raise ValueError(f"sensors.{name}: no action asks for it; declare one, such as Action(terms.move_frame)")
        view = views[sensor.robot]
        for joint in sensor.driven(views):
            joint_name = view.joint_names[joint]
            if view.actuators[joint] < 0:
                raise ValueError(
                    f"sensors.{name}: joint {joint_name} has no actuator; give the robot one, or leave the joint out of joints="
                )
            if (sensor.robot, joint) in driven:
                raise ValueError(
                    f"sensors.{name}: joint {joint_name} is driven by two terms; each joint has one action"
                )
            driven.add((sensor.robot, joint))
