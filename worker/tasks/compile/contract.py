"""The policy's contract, derived from a declaration: the meaning of each observation and action on a robot."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import mujoco

from shared_store.contract.policy import Action
from worker.simulation.sensors.differential_ik import AXES, DifferentialIK
from worker.tasks.compile.acting import frame_of
from worker.tasks.declare.declaration import Action as DeclaredAction
from worker.tasks.declare.declaration import Choice, Command
from worker.tasks.declare.interface import Interface, Observation

if TYPE_CHECKING:
    from worker.simulation.robot_view import RobotView
    from worker.simulation.worlds import Worlds
    from worker.tasks.compile.plan import Column, Driven, KernelPlan, Seen

UNITS: Mapping[str, tuple[str, str]] = {"effort": ("N m", "N"), "position": ("rad", "m"), "velocity": ("rad/s", "m/s")}
"""Unit of an actuator's input on a revolute joint, and on a prismatic one."""


DIRECT = frozenset({"effort", "position_target", "velocity_target"})
"""Functions that pass their value on unchanged."""
Explicit = Mapping[str, Sequence[float]]
"""``stiffness``, ``damping`` and ``effort_limit`` of each actuator of one world, and whether its force is computed ``explicit``ly."""


def contract(plan: KernelPlan, worlds: Worlds) -> Interface:
    """Observations and actions of the policy, in order.

    Args:
        plan: The task's.
        worlds: Gains and limits of the actuators are read from their model.
    """
    model, attributes = worlds.solver.mj_model, getattr(worlds.model, "muster", None)
    motors: Explicit | None = None
    if attributes is not None and worlds.drives is not None:  # forces that are computed explicitly
        names = ("explicit", "stiffness", "damping", "effort_limit")
        motors = {name: getattr(attributes, name).numpy()[: model.nu].tolist() for name in names}
    observations = [
        column for seen in plan.groups["policy"] for back in backs(seen) for column in described(plan, seen, back)
    ]
    if plan.choice:
        assert isinstance(plan.choice.term, Choice)
        actions = [
            Action(name, "choice", "1", scale=1.0, default_position=0.0, targets=targets)
            for name, targets in zip(plan.choice.term.names, plan.choice.term.targets, strict=True)
        ]
    else:
        actions = [action for driven in plan.driven for action in _actions(plan, driven, model, motors)]
    return Interface(tuple(observations), tuple(actions))


def backs(seen: Seen) -> range:
    """Age in steps of each part of a term's history, the oldest first."""
    return range(seen.term.history - 1, -1, -1)


def described(plan: KernelPlan, seen: Seen, back: int = 0) -> list[Observation]:
    """Description of each column of a term, at the present step or ``back`` steps ago."""
    term, names = seen.term, seen.names
    units = [term.unit] * len(names) if isinstance(term.unit, str) else list(term.unit)
    kind = term.kind or ("command" if seen.bound.takes("command") else None)
    kind = kind or ("previous_action" if seen.bound.takes("action") else "measured")
    ranges: Sequence[Any] = [None] * len(names)
    if kind == "command" and seen.bound.takes("command"):
        units, ranges = _commanded(plan, seen, units)
    clip = None if seen.clip is None else plan.numbers.pair(seen.clip)
    return [
        Observation(
            f"{name}_{back}" if back else name,
            units[index],
            value_of(plan, seen.scale, index, 1.0),
            value_of(plan, seen.offset, index, 0.0),
            kind,
            ranges[index],
            clip,
            back,
        )
        for index, name in enumerate(names)
    ]


def value_of(plan: KernelPlan, column: Column | None, index: int, otherwise: float) -> float:
    """The number that a kernel applies to a column."""
    if column is None:
        return otherwise
    return plan.numbers.values[column.first + (index if column.each else 0)]


def _commanded(plan: KernelPlan, seen: Seen, units: list[str]) -> tuple[list[str], list[Any]]:
    """Units and ranges of a command's columns, if the term uses them all."""
    name = seen.bound.term.parameters.get("command") or next(iter(plan.declaration.commands))
    command: Command = plan.declaration.commands[name]
    if len(command.names) != len(seen.names):
        return units, [None] * len(seen.names)
    ranges = [range_of(plan, name, command, column) for column in command.names]
    return (list(command.units) if seen.term.unit == "1" else units), ranges


def range_of(plan: KernelPlan, name: str, command: Command, column: str) -> tuple[float, float] | None:
    """Least and greatest value of a column of a command in training; None if unknown."""
    if column in command.ranges:
        return command.ranges[column]
    first, count = plan.numbers.places.get(f"commands.{name}.{column}", (0, 0))
    return plan.numbers.pair(first) if count == 2 else None


def _actions(plan: KernelPlan, driven: Driven, model: Any, motors: Explicit | None) -> list[Action]:
    term = driven.bound.term
    assert isinstance(term, DeclaredAction)
    clip = None if driven.clip is None else plan.numbers.pair(driven.clip)
    if frame := frame_of(driven.bound, plan.declaration.sensors):
        return _movements(plan, driven, frame, clip)
    view = plan.views[term.robot]
    found = []
    slide = int(mujoco.mjtJoint.mjJNT_SLIDE)
    for index, joint in enumerate(driven.bound.elements or ()):
        actuator = view.actuators[joint]
        gain = float(model.actuator_gear[actuator, 0] * model.actuator_gainprm[actuator, 0])
        stiffness, damping = gain if driven.kind == "position" else 0.0, -float(model.actuator_biasprm[actuator, 2])
        effort = view.efforts[joint]
        is_effort = driven.kind == "effort"
        if motors is not None and motors["explicit"][actuator]:
            stiffness, damping, effort = (float(motors[name][actuator]) for name in _GAINS)
            is_effort = False
        scale, offset = value_of(plan, driven.scale, index, 1.0), value_of(plan, driven.offset, index, 0.0)
        scale, offset, limits = _as_input(term, view, joint, scale, offset, gain if is_effort else 1.0)
        found.append(
            Action(
                view.joint_names[joint],
                driven.kind,
                term.unit or UNITS[driven.kind][int(model.jnt_type[model.actuator_trnid[actuator, 0]] == slide)],
                scale=scale,
                default_position=view.defaults[joint],
                offset=offset,
                clip=_both(clip, limits),
                stiffness=stiffness,
                damping=0.0 if is_effort else damping,
                range=_range(view, joint),
                effort_limit=effort if effort != float("inf") else abs(gain) if is_effort else None,
                rule=_rule(term),
            )
        )
    return found


def _movements(
    plan: KernelPlan, driven: Driven, frame: DifferentialIK, clip: tuple[float, float] | None
) -> list[Action]:
    """One action for each column of a frame that inverse kinematics moves."""
    term = driven.bound.term
    assert isinstance(term, DeclaredAction)
    return [
        Action(
            name,
            "position",
            term.unit or ("m" if axis in AXES[:3] else "rad" if axis in AXES else "1"),
            scale=value_of(plan, driven.scale, index, 1.0),
            default_position=0.0,
            offset=value_of(plan, driven.offset, index, 0.0),
            clip=clip,
            rule=f"{_rule(term)} Then {frame.description(plan.views)}",
        )
        for index, (name, axis) in enumerate(zip(driven.bound.element_names, frame.axes, strict=False))
    ]


def _range(view: RobotView, joint: int) -> tuple[float, float] | None:
    low, high = (float(end) for end in view.ranges[joint])
    return (low, high) if math.isfinite(low) and math.isfinite(high) else None


_GAINS = ("stiffness", "damping", "effort_limit")


def _as_input(
    term: DeclaredAction, view: RobotView, joint: int, scale: float, offset: float, gain: float
) -> tuple[float, float, tuple[float, float] | None]:
    """Scale and offset of an action as an actuator's input, and the limits that its function puts on the action."""
    if term.function_name == "share_of_range_target":
        low, high = view.ranges[joint]
        middle, half = 0.5 * (low + high), 0.5 * (high - low)
        return half * scale, middle + half * offset, _within_one(scale, offset)
    if term.function_name == "limited_effort":
        greatest = view.efforts[joint] if view.efforts[joint] != float("inf") else 1.0
        return greatest * scale, greatest * offset, _within_one(scale, offset)
    return gain * scale, gain * offset, None


def _within_one(scale: float, offset: float) -> tuple[float, float] | None:
    """The actions whose value is within [-1, 1]."""
    if scale == 0.0:
        return None
    ends = ((-1.0 - offset) / scale, (1.0 - offset) / scale)
    return min(ends), max(ends)


def _both(first: tuple[float, float] | None, second: tuple[float, float] | None) -> tuple[float, float] | None:
    if first is None or second is None:
        return first or second
    return max(first[0], second[0]), min(first[1], second[1])


def _rule(term: DeclaredAction) -> str:
    """Description of a function's effect where a scale and an offset do not suffice: its docstring and its numbers."""
    if term.function_name in DIRECT | {"share_of_range_target", "limited_effort"}:
        return ""
    text = (
        getattr(term.function, "__doc__", None) or getattr(getattr(term.function, "func", None), "__doc__", None) or ""
    )
    words = " ".join(text.split("\n\n")[0].split()) or f"the task's own function {term.function_name}"
    numbers = ", ".join(
        f"{name} = {value:g}" for name, value in term.parameters.items() if isinstance(value, int | float)
    )
    return f"{words} ({numbers})" if numbers else words
