"""Turns the policy's actions into joint commands, within limits."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from muster_policy.contract import Action, Contract
from muster_policy.errors import Refused
from muster_policy.messages import Messages

KINDS = ("position", "velocity", "effort")
"""Kinds of joint commands, named as the fields of a ``sensor_msgs/JointState``."""


@dataclass(frozen=True)
class Command:
    """Joint commands of one moment.

    Attributes:
        values: One for each action, in their order [unit of each].
        limited: Number of values that the limits changed.
    """

    values: np.ndarray
    limited: int


class Commands:
    """Makes joint commands.

    Args:
        contract: Of the policy.
        names: Name of a joint on the robot by its name in the contract, if it differs.
        strict: Keep position targets within the joints' ranges; otherwise they may exceed them by ``effort_limit / stiffness``, as far
            as a target can still change the actuator's torque.

    Raises:
        Refused: An action is not a joint command, or has a rule beyond a scale and an offset.
    """

    def __init__(self, contract: Contract, names: Mapping[str, str] | None = None, strict: bool = False) -> None:
        if not contract.actions:
            labels = ", ".join(contract.action_names[:5])
            raise Refused(
                f"task {contract.task} can't drive joints: the policy does not say what its actions are: {labels}"
            )
        self._choices = _choices(contract) if contract.discrete else None
        if ruled := [action for action in contract.actions if action.rule]:
            raise Refused(
                f"task {contract.task}: the command of {ruled[0].name} has a rule that the node lacks: {ruled[0].rule}"
            )
        self.actions = _joints(contract.actions[0]) if contract.discrete else contract.actions
        renamed = names or {}
        self.joints = [renamed.get(action.name, action.name) for action in self.actions]
        kinds = [action.kind for action in self.actions]
        self.kinds = {kind: [i for i, each in enumerate(kinds) if each == kind] for kind in KINDS if kind in kinds}
        self._scale = np.array([action.scale for action in self.actions])
        self._offset = np.array([action.offset for action in self.actions])
        clips = [action.clip or (-np.inf, np.inf) for action in self.actions]
        self._least, self._most = np.array(clips).T
        self._low, self._high = np.array([limits(action, strict) for action in self.actions]).T

    def command(self, action: np.ndarray) -> Command:
        """Commands for the policy's action, shape ``(actions,)``, finite; or for the number of its choice, shape ``(1,)``."""
        if self._choices is not None:
            return Command(self._choices[int(np.clip(round(float(action[0])), 0, len(self._choices) - 1))], 0)
        value = self._offset + self._scale * np.clip(action.astype(np.float64), self._least, self._most)
        limited = np.clip(value, self._low, self._high)
        return Command(limited, int((limited != value).sum()))

    def hold(self, positions: Mapping[str, float]) -> Command:
        """Commands that hold the robot where it is: the measured positions as targets, no velocity, no force.

        Args:
            positions: Measured positions, by the joint's name in the contract [m, rad].
        """
        held = [positions[action.name] if action.kind == "position" else 0.0 for action in self.actions]
        return Command(np.array(held), 0)

    def joint_states(self, command: Command, messages: Messages, nanoseconds: int) -> list[Any]:
        """A command as ``sensor_msgs/JointState``: one message of each kind of command, with its joints alone."""
        header, found = messages.header(nanoseconds), []
        for kind, columns in self.kinds.items():
            values = dict.fromkeys(KINDS, np.zeros(0)) | {kind: command.values[columns]}
            names = [self.joints[column] for column in columns]
            found.append(messages.make("sensor_msgs/msg/JointState", header=header, name=names, **values))
        return found

    def table(self) -> list[str]:
        """The joints with their default positions, gains and limits, a line each, to set up the robot's controllers."""
        width = max(map(len, self.joints))
        lines = []
        for name, action in zip(self.joints, self.actions, strict=True):
            low, high = limits(action, False)
            effort = "" if action.effort_limit is None else f", effort up to {action.effort_limit:.4g}"
            lines.append(
                f"  {name:{width}}  {action.kind} [{action.unit}] {low:.3f} to {high:.3f}, default position "
                f"{action.default_position:.4f}, stiffness {action.stiffness:.4g}, damping {action.damping:.4g}{effort}"
            )
        return lines


def _choices(contract: Contract) -> np.ndarray:
    """The commands of each choice, shape ``(choices, joints)``. Raises Refused where the contract lacks them."""
    joints = [[(each.joint, each.kind) for each in action.targets] for action in contract.actions]
    for action, each in zip(contract.actions, joints, strict=True):
        if not each or each != joints[0]:
            raise Refused(
                f"task {contract.task} can't drive joints: the contract does not say what the choice {action.name} asks of them; "
                "export the policy again, of a task that declares it"
            )
    return np.array([[each.value for each in action.targets] for action in contract.actions])


def _joints(choice: Action) -> tuple[Action, ...]:
    """The joints that a choice commands, as actions without gains and limits: the contract has none of them."""
    return tuple(
        Action(each.joint, each.kind, each.unit, 1.0, 0.0, None, 0.0, 0.0, 0.0, None, "") for each in choice.targets
    )


def limits(action: Action, strict: bool) -> tuple[float, float]:
    """Least and greatest command of a joint; infinite without limits in the contract."""
    if action.kind == "effort":
        most = np.inf if action.effort_limit is None else action.effort_limit
        return -most, most
    if action.kind == "velocity" or action.range is None:
        return -np.inf, np.inf
    beyond = 0.0
    if not strict and action.stiffness > 0.0:
        beyond = np.inf if action.effort_limit is None else action.effort_limit / action.stiffness
    return action.range[0] - beyond, action.range[1] + beyond
