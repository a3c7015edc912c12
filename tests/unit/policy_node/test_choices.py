"""A policy that chooses one of several actions: the node commands what the contract says of the choice."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest

from muster_policy.actions import Commands
from muster_policy.contract import read as node_read
from muster_policy.errors import Refused
from muster_policy.messages import Messages
from muster_policy.observations import Observations
from shared_store.contract.policy import Action, Contract, Group, Target, read
from tests.support.policy_node import for_node
from tests.unit.policy_node.walker import term

WHEEL = {"element": "joint", "elements": ("wheel",)}
SEEN = term("joint_position", 0, 1, **WHEEL)


def choosing(*targets: tuple[Target, ...]) -> Contract:
    """Of a car: each choice asks for a steering angle and a speed."""
    choices = tuple(
        Action(f"{number}", "choice", "1", scale=1.0, default_position=0.0, targets=each)
        for number, each in enumerate(targets)
    )
    group = Group("policy", "obs", (1,), "float32", (SEEN,))
    return Contract("Car", "1", 15.0, (group,), choices, tuple(each.name for each in choices), discrete=True)


def requested(angle: float, speed: float) -> tuple[Target, ...]:
    return Target("steering", "position", "rad", angle), Target("wheel", "velocity", "rad/s", speed)


def test_a_choice_commands_its_targets() -> None:
    contract = for_node(choosing(requested(0.5, 1.0), requested(0.0, 2.0), requested(-0.5, 1.0)))
    commands = Commands(contract, {"steering": "servo"})
    assert commands.joints == ["servo", "wheel"] and Observations(contract).joints == ("steering", "wheel")
    for number, expected in enumerate(([0.5, 1.0], [0.0, 2.0], [-0.5, 1.0])):
        command = commands.command(np.array([number], np.float32))
        assert command.values.tolist() == expected and command.limited == 0
    position, velocity = commands.joint_states(commands.command(np.array([2.0], np.float32)), Messages(), 0)
    assert (list(position.name), list(position.position)) == (["servo"], [-0.5])
    assert (list(velocity.name), list(velocity.velocity)) == (["wheel"], [1.0])
    assert commands.hold({"steering": 0.25, "wheel": 3.0}).values.tolist() == [0.25, 0.0]
    assert "servo  position [rad]" in commands.table()[0]


@pytest.mark.parametrize(
    "contract",
    [choosing((), ()), choosing(requested(0.5, 1.0), ()), choosing(requested(0.5, 1.0), requested(0.0, 1.0)[::-1])],
)
def test_a_contract_that_does_not_say_what_a_choice_asks_for_is_refused(contract: Contract) -> None:
    with pytest.raises(
        Refused, match=r"the contract does not say what the choice [01] asks of them; export the policy again"
    ):
        Commands(for_node(contract))


def test_a_contract_of_the_format_before_is_read() -> None:
    document = choosing((), ()).document()
    for action in document["actions"]:
        del action["targets"]
    assert read({**document, "format": 2}) == dataclasses.replace(choosing((), ()), format=2)
    assert node_read(json.dumps({**document, "format": 2}).encode(), "contract.json").actions[0].targets == ()
