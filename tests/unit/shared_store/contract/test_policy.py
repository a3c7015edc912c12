"""The policy contract as a document: what can be read, and in what two of them differ."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Callable
from typing import Any

import jsonschema
import pytest

from orchestrator.spec.json_schema import contract_schema
from shared_store.contract.documents import DocumentError
from shared_store.contract.policy import Action, Command, Contract, Group, Image, State, Term, read
from shared_store.contract.policy_changes import differences
from tests.conftest import REPOSITORY

ANGLES = Term(
    name="joint_pos",
    kind="measured",
    first=0,
    names=("left_knee", "right_knee"),
    units=("rad", "rad"),
    scale=(1.0, 1.0),
    offset=(0.5, -0.5),
    clip=(-3.0, math.inf),
    history=2,
    quantity="joint_position",
    parameters={"gain": (2.0,)},
    robot="robot",
    element="joint",
    elements=("left_knee", "right_knee"),
    sensors={"imu": "ImuSensor, site imu"},
)
SPEED = Term("speed", "command", 4, ("speed",), ("m/s",), (2.0,), (0.0,), ranges=((-1.0, 1.0),), command="velocity")
CONTRACT = Contract(
    task="Walker",
    muster="0.1.0",
    control_hz=50.0,
    groups=(
        Group("policy", "obs", (5,), "float32", (ANGLES, SPEED)),
        Group("front", "front", (6, 8, 8), "uint8", image=Image(("red", "green", "blue"), 2, {"fov": 0.9})),
    ),
    actions=(
        Action("left_knee", "position", "rad", 0.25, 0.5, offset=0.5, stiffness=20.0, damping=0.5, effort_limit=30.0),
        Action("right_knee", "position", "rad", 0.25, -0.5, offset=-0.5, clip=None),
    ),
    action_names=("left_knee", "right_knee"),
    commands=(Command("velocity", ("speed",), ("m/s",), ((-1.0, 1.0),), (5.0, 10.0)),),
    states=(State("h", "h_out", (1, 64)),),
)


def document(change: Callable[[dict[str, Any]], Any] = lambda document: None) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(json.dumps(CONTRACT.document()))
    change(found)
    return found


def test_a_contract_that_was_written_reads_the_same_and_fits_its_published_schema() -> None:
    published = json.loads((REPOSITORY / "docs/policy-contract.schema.json").read_text())
    assert published == contract_schema(), "muster schema --contract > docs/policy-contract.schema.json"
    jsonschema.validate(document(), published)
    again = read(document())
    assert again.document() == document() and differences(CONTRACT, again, ranges=True) == []
    angles = again.groups[0].terms[0]
    assert angles.clip == (-3.0, pytest.approx(3.4e38, rel=0.01)), "JSON has no infinity"
    assert dataclasses.replace(angles, clip=ANGLES.clip) == ANGLES
    assert (again.actions, again.commands, again.states) == (CONTRACT.actions, CONTRACT.commands, CONTRACT.states)
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(document(lambda found: found["actions"][0].pop("unit")), published)


MALFORMED = {
    "has format 5, this Muster reads up to 4; upgrade Muster": lambda found: found.update(format=5),
    "task is missing": lambda found: found.pop("task"),
    "actions.1: unknown key 'scal'; did you mean scale?": lambda found: found["actions"][1].update(scal=1.0),
    "actions.0.kind: expected one of 'effort', 'position', 'velocity', 'choice', found 'postion'": lambda found: found[
        "actions"
    ][0].update(kind="postion"),
    "actions.0.clip: expected a list of 2, found [1.0]": lambda found: found["actions"][0].update(clip=[1.0]),
    "control_hz: expected a number, found '50'": lambda found: found.update(control_hz="50"),
    "discrete: expected true or false, found 1": lambda found: found.update(discrete=1),
    "groups.policy.speed: begins at 3, and the terms before it end at 4": lambda found: found["groups"][0]["terms"][
        1
    ].update(first=3),
    "groups.policy: its terms have 5 numbers, its shape is [6]": lambda found: found["groups"][0].update(shape=[6]),
    "groups.policy.joint_pos: names, units, scale, offset and ranges have different lengths": lambda found: found[
        "groups"
    ][0]["terms"][0].update(scale=[1.0]),
    "action_names are not the names of actions, in order": lambda found: found.update(
        action_names=["right_knee", "left_knee"]
    ),
}


@pytest.mark.parametrize("message", MALFORMED)
def test_a_malformed_contract_is_refused_in_one_line(message: str) -> None:
    change = MALFORMED[message]
    with pytest.raises(DocumentError) as caught:
        read(document(change))
    assert str(caught.value) == f"contract.json: {message}"


def test_a_contract_of_format_1_is_read_with_fewer_entries() -> None:
    def older(found: dict[str, Any]) -> None:
        found["format"] = 1
        for each in found["groups"][0]["terms"]:
            del each["frame"], each["library"]
        for each in found["actions"]:
            del each["range"]
        for each in found["commands"]:
            del each["quantity"], each["library"]

    existing = read(document(older))
    assert existing.format == 1 and not existing.groups[0].terms[0].library and existing.actions[0].range is None
    assert differences(existing, CONTRACT) == [] == differences(CONTRACT, existing)


def test_values_that_follow_from_a_robot_s_file_can_be_left_out_and_meanings_can_not() -> None:
    def changed(found: dict[str, Any]) -> None:
        found["actions"][0].update(
            stiffness=30.0, damping=1.0, scale=0.5, offset=0.4, default_position=0.4, effort_limit=20.0
        )
        found["groups"][0]["terms"][0].update(offset=[0.4, -0.4])

    existing = read(document(changed))
    assert len(differences(CONTRACT, existing)) == 10 and differences(CONTRACT, existing, of_robot=False) == []
    other = read(document(lambda found: found["actions"][0].update(kind="effort", unit="N m", damping=1.0)))
    assert differences(CONTRACT, other, of_robot=False) == [
        "action 0: left_knee kind position became effort",
        "action 0: left_knee unit rad became N m",
    ]
