"""Changes that a policy would misunderstand: the differences between two policy contracts, one line each."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from shared_store.contract.policy import LARGEST, Action, Contract, Group, RobotModel

CLOSE = 1e-6
"""Relative difference up to which two numbers count as equal: recompiling a model rounds."""
_OF_ROBOT = ("scale", "offset", "default_position", "stiffness", "damping", "effort_limit")
"""Values of actions and observations that may follow from a robot's file."""


def differences(before: Contract, now: Contract, *, ranges: bool = False, of_robot: bool = True) -> list[str]:
    """The points in which a policy of ``before`` would misunderstand ``now``, one line each; empty if both mean the same.

    Args:
        before: The contract of the policy's training.
        now: The contract that it would meet.
        ranges: Also compare properties of the training: ranges and durations of commands, delays.
        of_robot: Also compare values that may follow from a robot's file, such as the scale and the damping of an action.
    """
    left_out = () if of_robot else _OF_ROBOT
    lines = []
    if before.control_hz != now.control_hz:
        lines.append(f"the control rate {before.control_hz:g} Hz became {now.control_hz:g} Hz")
    for group in before.groups:
        same = now.group(group.name)
        if same is None:
            lines.append(f"the observation group {group.name} is gone")
        else:
            lines += _group_differences(group, same, ranges, left_out)
    lines += [f"the observation group {group.name} is new" for group in now.groups if not before.group(group.name)]
    lines += _named(_actions(before, left_out), _actions(now, left_out), "action")
    lines += _command_differences(before, now, ranges)
    old, new = (
        ", ".join(f"{state.name} {list(state.shape)}" for state in each.states) or "none" for each in (before, now)
    )
    return lines + ([f"the recurrent state {old} became {new}"] if old != new else [])


def robot_changes(before: Sequence[RobotModel], now: Sequence[RobotModel]) -> list[str]:
    """The robots that load otherwise now than before, one line each; those that only one side knows don't count."""
    known = {robot.name: robot for robot in before}
    lines = []
    for robot in now:
        then = known.get(robot.name)
        if then is None or then.digest == robot.digest:
            continue
        pairs = (
            ("mass [kg]", then.mass, robot.mass),
            ("joints", then.joints, robot.joints),
            ("actuators", then.actuators, robot.actuators),
        )
        changed = [f"{what} {old:g} became {new:g}" for what, old, new in pairs if old != new]
        changed += _element_changes(then, robot)
        lines.append(f"{robot.name}: {brief(changed, 4) or 'other values of its compiled model changed'}")
    return lines


def _element_changes(before: RobotModel, now: RobotModel) -> Iterator[str]:
    """The elements that changed, as far as contracts name their values."""
    old, new = before.elements, now.elements
    known = {name.partition(" ")[0] for name in old} & {name.partition(" ")[0] for name in new}
    both_whole = "model" in known
    for element in {**new, **old}:
        if not both_whole and element.partition(" ")[0] not in known:
            continue  # read from another kind of file, or by an older Muster
        if (element in old) != (element in new):
            yield f"{element} is {'new' if element in new else 'gone'}"
            continue
        for name in {**new[element], **old[element]}:
            pair = old[element].get(name, 0.0), new[element].get(name, 0.0)
            if not _same(*pair):
                then, present = (each if isinstance(each, str) else f"{each:g}" for each in pair)
                yield f"{element}: {name} {then} became {present}"


def brief(lines: Sequence[str], most: int = 5) -> str:
    """The first differences in one line, and the number of further ones."""
    more = f"; and {len(lines) - most} more" if len(lines) > most else ""
    return "; ".join(lines[:most]) + more


def _group_differences(before: Group, now: Group, ranges: bool, left_out: Sequence[str]) -> list[str]:
    of = "" if before.name == "policy" else f" of {before.name}"
    lines = []
    if before.terms and now.terms:
        lines = _named(_columns(before, ranges, left_out), _columns(now, ranges, left_out), f"observation{of}")
    if before.image and now.image:
        old, new = (dataclasses.asdict(each) for each in (before.image, now.image))
        for each in (old, new):
            each.update(each.pop("camera"))  # its settings stand beside the others
        lines += [f"image{of}: {line}" for line in _changed(old, new)]
    if not lines and (before.shape, before.dtype) != (now.shape, now.dtype):
        lines.append(
            f"the observations{of} of shape {list(before.shape)}, {before.dtype}, became {list(now.shape)}, {now.dtype}"
        )
    return lines


def _columns(group: Group, ranges: bool, left_out: Sequence[str]) -> dict[str, dict[str, Any]]:
    """The meaning of each number of a group, by its label, in order."""
    found = {}
    for term in group.terms:
        common: dict[str, Any] = {
            **{name: getattr(term, name) for name in ("kind", "clip", "quantity", "robot", "command")},
            **{f"parameter {name}": value for name, value in term.parameters.items()},
            **{f"sensor {name}": value for name, value in term.sensors.items()},
            "frame": term.frame and (term.frame.body, *term.frame.position, *term.frame.rotation),
            **({"delay": term.delay} if ranges else {}),
        }
        each = len(term.names) // len(term.elements) if term.elements else 0
        for back in range(term.history - 1, -1, -1):
            for index, name in enumerate(term.names):
                label = name if name == term.name else f"{term.name}/{name}"
                values = {"scale": term.scale[index], "offset": term.offset[index]}
                found[f"{label} ({back} steps ago)" if back else label] = {
                    **common,
                    "unit": term.units[index],
                    **{name: value for name, value in values.items() if name not in left_out},
                    **({"element": term.elements[index // each]} if each else {}),
                    **({"range": term.ranges[index]} if ranges and term.ranges else {}),
                }
    return found


def _actions(contract: Contract, left_out: Sequence[str]) -> dict[str, dict[str, Any]]:
    if not contract.actions:
        return {name: {} for name in contract.action_names}
    fields = [field.name for field in dataclasses.fields(Action) if field.name not in ("name", "range", *left_out)]
    return {action.name: {name: getattr(action, name) for name in fields} for action in contract.actions}


def _command_differences(before: Contract, now: Contract, ranges: bool) -> list[str]:
    compared = ("names", "units", *(("ranges", "seconds") if ranges else ()))
    old, new = (
        {each.name: {name: getattr(each, name) for name in compared} for each in contract.commands}
        for contract in (before, now)
    )
    lines = [f"the command {name} is {'new' if name in new else 'gone'}" for name in old.keys() ^ new.keys()]
    for name in old.keys() & new.keys():
        lines += [f"command {name}: {line}" for line in _changed(old[name], new[name])]
    return sorted(lines)


def _named(before: dict[str, dict[str, Any]], now: dict[str, dict[str, Any]], what: str) -> list[str]:
    """The changes of ordered, named items: ``observation 12: joint_pos/left_knee scale 1 became 0.5``."""
    old, new = list(before), list(now)
    lines = [f"{what} {old.index(name)}: {name} is gone" for name in old if name not in now]
    lines += [f"{what} {new.index(name)}: {name} is new" for name in new if name not in before]
    if not lines:  # otherwise all later items have moved
        moved = [(name, new.index(name)) for index, name in enumerate(old) if new[index] != name]
        lines = [f"{what} {old.index(name)}: {name} became {what} {place}" for name, place in moved]
    for index, name in enumerate(old):
        if name in now:
            lines += [f"{what} {index}: {name} {line}" for line in _changed(before[name], now[name])]
    return lines


def _changed(before: Mapping[str, Any], now: Mapping[str, Any]) -> Iterator[str]:
    for name in {**before, **now}:
        old, new = before.get(name), now.get(name)
        if (name in before) != (name in now):
            yield f"{name} {_value(new if name in now else old)} is {'new' if name in now else 'gone'}"
        elif (name == "frame" and None in (old, new)) or (name == "targets" and () in (old, new)):
            continue  # a contract of format 1, or 2, lacks it
        elif not _same(old, new):
            yield f"{name} {_value(old)} became {_value(new)}"


def _same(one: Any, other: Any) -> bool:
    if isinstance(one, tuple | list) and isinstance(other, tuple | list):
        return len(one) == len(other) and all(map(_same, one, other))
    if isinstance(one, float | int) and isinstance(other, float | int):
        one, other = (min(max(each, -LARGEST), LARGEST) for each in (one, other))
        return math.isclose(one, other, rel_tol=CLOSE, abs_tol=CLOSE * 1e-3)
    return bool(one == other)


def _value(value: Any) -> str:
    if isinstance(value, tuple | list):
        return "[" + ", ".join(map(_value, value)) + "]"
    if value is None or value == "":
        return "none"
    return str(value)
