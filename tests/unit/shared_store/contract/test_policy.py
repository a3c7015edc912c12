"""The policy contract as a document: what can be read, and in what two of them differ."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jsonschema
import pytest

from orchestrator.spec.json_schema import contract_schema
from shared_store.contract.documents import DocumentError
from shared_store.contract.policy import (
    LARGEST,
    Action,
    Command,
    Contract,
    Frame,
    Group,
    Image,
    State,
    Target,
    Term,
    read,
)
from shared_store.contract.policy_changes import brief, differences
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
    assert replace(angles, clip=ANGLES.clip) == ANGLES
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


def test_values_that_follow_from_a_robot_s_file_can_be_left_out_unlike_meanings() -> None:
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


# -- differences, point by point ---------------------------------------------------------------------------------------

TERM = Term(
    "wheels", "measured", 0, ("a", "b"), ("m", "m"), (1.0, 1.0), (0.0, 0.0), element="joint", elements=("l", "r")
)
COMMAND = Command("go", ("v",), ("m/s",), (None,), (1.0, 2.0))
CAR = Contract(
    "Car", "1", 20.0, (Group("critic", "obs", (2,), "float32", (TERM,)),), (), ("left", "right"), commands=(COMMAND,)
)
BARE = replace(CAR, groups=(Group("policy", "obs", (2,), "float32"),), commands=())
IMAGES = replace(BARE, groups=(Group("policy", "obs", (3, 8, 8), "uint8", image=Image(("r",), 1, {"fov": 0.9})),))
CHOICE = Action("left", "choice", "", 1.0, 0.0, targets=(Target("knee", "effort", "N m", 1.0),))


def with_term(**changes: Any) -> Contract:
    return replace(CAR, groups=(replace(CAR.groups[0], terms=(replace(TERM, **changes),)),))


def with_group(contract: Contract, **changes: Any) -> Contract:
    return replace(contract, groups=(replace(contract.groups[0], **changes),))


def with_command(**changes: Any) -> Contract:
    return replace(CAR, commands=(replace(COMMAND, **changes),))


def with_choice(**changes: Any) -> Contract:
    return replace(BARE, actions=(replace(CHOICE, **changes),), action_names=("left",))


A, B = "observation of critic 0: wheels/a", "observation of critic 1: wheels/b"
DIFFERENCES: dict[str, tuple[Contract, Contract, list[str]]] = {
    "a rate": (CAR, replace(CAR, control_hz=60.0), ["the control rate 20 Hz became 60 Hz"]),
    "a kind": (CAR, with_term(kind="previous_action"), [f"{each} kind measured became previous_action" for each in (A, B)]),
    "a clip": (CAR, with_term(clip=(-1.0, 1)), [f"{each} clip none became [-1.0, 1]" for each in (A, B)]),
    "a quantity": (CAR, with_term(quantity="q"), [f"{each} quantity none became q" for each in (A, B)]),
    "a robot": (CAR, with_term(robot="r"), [f"{each} robot none became r" for each in (A, B)]),
    "a command": (CAR, with_term(command="c"), [f"{each} command none became c" for each in (A, B)]),
    "a unit": (CAR, with_term(units=("m", "ft")), [f"{B} unit m became ft"]),
    "a scale": (CAR, with_term(scale=(1.0, 2.0)), [f"{B} scale 1.0 became 2.0"]),
    "an offset": (CAR, with_term(offset=(0.0, 2.0)), [f"{B} offset 0.0 became 2.0"]),
    "an element": (CAR, with_term(elements=("l", "x")), [f"{B} element r became x"]),
    "one element of two numbers": (with_term(elements=("l",)), with_term(elements=("x",)), [f"{each} element l became x" for each in (A, B)]),
    "elements that are gone": (CAR, with_term(elements=()), [f"{A} element l is gone", f"{B} element r is gone"]),
    "a parameter": (with_term(parameters={"g": (1.0,)}), with_term(parameters={"g": (2.0,)}), [f"{each} parameter g [1.0] became [2.0]" for each in (A, B)]),
    "a sensor": (CAR, with_term(sensors={"imu": "x"}), [f"{each} sensor imu x is new" for each in (A, B)]),
    "a term's name": (CAR, with_term(name="a"), ["observation of critic 0: wheels/a is gone", "observation of critic 1: wheels/b is gone", "observation of critic 0: a is new", "observation of critic 1: a/b is new"]),
    "longer history": (CAR, with_group(with_term(history=2), shape=(4,)), ["observation of critic 0: wheels/a (1 steps ago) is new", "observation of critic 1: wheels/b (1 steps ago) is new"]),
    "terms that one alone declares": (CAR, with_group(CAR, terms=()), []),
    "a shape of undeclared terms": (BARE, with_group(BARE, shape=(3,)), ["the observations of shape [2], float32, became [3], float32"]),
    "of another group": (with_group(CAR, terms=()), with_group(CAR, terms=(), dtype="uint8"), ["the observations of critic of shape [2], float32, became [2], uint8"]),
    "an image": (IMAGES, with_group(IMAGES, image=Image(("r",), 2, {"fov": 0.8}, "none")), ["image: frames 1 became 2", "image: scaling none: the policy takes the bytes, 0 to 255, and scales them itself became none", "image: fov 0.9 became 0.8"]),
    "an image's shape": (IMAGES, with_group(IMAGES, shape=(3, 4, 4)), ["the observations of shape [3, 8, 8], uint8, became [3, 4, 4], uint8"]),
    "an image's shape beside what says more": (IMAGES, with_group(IMAGES, shape=(1, 8, 8), image=Image(("g",), 1, {"fov": 0.9})), ["image: channels [r] became [g]"]),
    "groups": (BARE, replace(BARE, groups=(replace(BARE.groups[0], name="x"),)), ["the observation group policy is gone", "the observation group x is new"]),
    "undeclared actions": (BARE, replace(BARE, action_names=("right", "left")), ["action 0: left became action 1", "action 1: right became action 0"]),
    "fewer actions": (BARE, replace(BARE, action_names=("right",)), ["action 0: left is gone"]),
    "more actions": (BARE, replace(BARE, action_names=("left", "up", "right")), ["action 1: up is new"]),
    "an action's range": (with_choice(), with_choice(range=(0.0, 1.0)), []),
    "undeclared targets": (with_choice(), with_choice(targets=()), []),
    "the same the other way": (with_choice(targets=()), with_choice(), []),
    "targets": (with_choice(), with_choice(targets=(CHOICE.targets[0], replace(CHOICE.targets[0], joint="hip"))), ["action 0: left targets [Target(joint='knee', kind='effort', unit='N m', value=1.0)] became [Target(joint='knee', kind='effort', unit='N m', value=1.0), Target(joint='hip', kind='effort', unit='N m', value=1.0)]"]),
    "no clip": (with_choice(), with_choice(clip=None), ["action 0: left clip [-1.0, 1.0] became none"]),
    "commands": (CAR, with_command(name="b"), ["the command b is new", "the command go is gone"]),
    "a command's names": (CAR, with_command(names=("w",), units=("1/s",)), ["command go: names [v] became [w]", "command go: units [m/s] became [1/s]"]),
    "states": (replace(BARE, states=(State("h", "o", (1, 2)), State("c", "p", (3,)))), BARE, ["the recurrent state h [1, 2], c [3] became none"]),
    "infinite limits": (with_choice(clip=(-math.inf, math.inf)), with_choice(clip=(-LARGEST, LARGEST * 2)), []),
    "nearly nothing": (with_choice(damping=0.0), with_choice(damping=0.9e-9), []),
    "little": (with_choice(damping=0.0), with_choice(damping=1.1e-9), ["action 0: left damping 0.0 became 1.1e-09"]),
    "rounded": (with_choice(damping=1.0), with_choice(damping=1.0 + 0.9e-6), []),
    "not only rounded": (with_choice(damping=1.0), with_choice(damping=1.0 + 1.1e-6), ["action 0: left damping 1.0 became 1.0000011"]),
}  # fmt: skip


@pytest.mark.parametrize("case", DIFFERENCES)
def test_each_difference_is_a_line(case: str) -> None:
    before, now, lines = DIFFERENCES[case]
    assert differences(before, now) == lines


def test_a_frame_is_compared_by_its_body_its_place_and_its_turn() -> None:
    frame = Frame("imu", "trunk", (0.0, 0.0, 0.1), (0.0, 0.0, 0.0, 1.0), True)
    before = with_term(frame=frame)
    assert differences(before, with_term(frame=replace(frame, name="other", root=False))) == []
    assert differences(before, CAR) == differences(CAR, before) == []
    for change in ({"body": "head"}, {"position": (0.0, 0.0, 0.2)}, {"rotation": (0.0, 0.0, 1.0, 0.0)}):
        assert len(differences(before, with_term(frame=replace(frame, **change)))) == 2


def test_what_only_training_is_about_is_compared_on_request() -> None:
    command, other = (
        with_term(kind="command", ranges=((0.0, 1.0), None)),
        with_term(kind="command", ranges=((0.0, 2.0), None), delay=(0, 1)),
    )
    assert differences(command, other) == []
    assert differences(command, other, ranges=True) == [
        f"{A} delay [0, 0] became [0, 1]",
        f"{A} range [0.0, 1.0] became [0.0, 2.0]",
        f"{B} delay [0, 0] became [0, 1]",
    ]
    assert differences(CAR, with_command(seconds=(1.0, 3.0)), ranges=True) == [
        "command go: seconds [1.0, 2.0] became [1.0, 3.0]"
    ]


def test_a_group_is_found_by_its_name_and_up_to_five_differences_are_all_shown() -> None:
    assert CAR.group("critic") is CAR.groups[0] and CAR.group("policy") is None
    assert brief(list("abcde")) == "a; b; c; d; e" and brief(list("abcdef")) == "a; b; c; d; e; and 1 more"
