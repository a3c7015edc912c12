"""Edges of the policy contract, beside test_policy.py: what is compared, and what counts as equal."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest

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
)
from shared_store.contract.policy_changes import brief, differences

TERM = Term(
    "wheels", "measured", 0, ("a", "b"), ("m", "m"), (1.0, 1.0), (0.0, 0.0), element="joint", elements=("l", "r")
)
COMMAND = Command("go", ("v",), ("m/s",), (None,), (1.0, 2.0))
CONTRACT = Contract(
    "Car", "1", 20.0, (Group("critic", "obs", (2,), "float32", (TERM,)),), (), ("left", "right"), commands=(COMMAND,)
)
BARE = replace(CONTRACT, groups=(Group("policy", "obs", (2,), "float32"),), commands=())
IMAGES = replace(BARE, groups=(Group("policy", "obs", (3, 8, 8), "uint8", image=Image(("r",), 1, {"fov": 0.9})),))
CHOICE = Action("left", "choice", "", 1.0, 0.0, targets=(Target("knee", "effort", "N m", 1.0),))


def with_term(**changes: Any) -> Contract:
    return replace(CONTRACT, groups=(replace(CONTRACT.groups[0], terms=(replace(TERM, **changes),)),))


def with_group(contract: Contract, **changes: Any) -> Contract:
    return replace(contract, groups=(replace(contract.groups[0], **changes),))


def with_command(**changes: Any) -> Contract:
    return replace(CONTRACT, commands=(replace(COMMAND, **changes),))


def with_choice(**changes: Any) -> Contract:
    return replace(BARE, actions=(replace(CHOICE, **changes),), action_names=("left",))


A, B = "observation of critic 0: wheels/a", "observation of critic 1: wheels/b"
DIFFERENCES: dict[str, tuple[Contract, Contract, list[str]]] = {
    "a rate": (CONTRACT, replace(CONTRACT, control_hz=60.0), ["the control rate 20 Hz became 60 Hz"]),
    "a kind": (CONTRACT, with_term(kind="previous_action"), [f"{each} kind measured became previous_action" for each in (A, B)]),
    "a clip": (CONTRACT, with_term(clip=(-1.0, 1)), [f"{each} clip none became [-1.0, 1]" for each in (A, B)]),
    "a quantity": (CONTRACT, with_term(quantity="q"), [f"{each} quantity none became q" for each in (A, B)]),
    "a robot": (CONTRACT, with_term(robot="r"), [f"{each} robot none became r" for each in (A, B)]),
    "a command": (CONTRACT, with_term(command="c"), [f"{each} command none became c" for each in (A, B)]),
    "a unit": (CONTRACT, with_term(units=("m", "ft")), [f"{B} unit m became ft"]),
    "a scale": (CONTRACT, with_term(scale=(1.0, 2.0)), [f"{B} scale 1.0 became 2.0"]),
    "an offset": (CONTRACT, with_term(offset=(0.0, 2.0)), [f"{B} offset 0.0 became 2.0"]),
    "an element": (CONTRACT, with_term(elements=("l", "x")), [f"{B} element r became x"]),
    "one element of two numbers": (with_term(elements=("l",)), with_term(elements=("x",)), [f"{each} element l became x" for each in (A, B)]),
    "elements that are gone": (CONTRACT, with_term(elements=()), [f"{A} element l is gone", f"{B} element r is gone"]),
    "a parameter": (with_term(parameters={"g": (1.0,)}), with_term(parameters={"g": (2.0,)}), [f"{each} parameter g [1.0] became [2.0]" for each in (A, B)]),
    "a sensor": (CONTRACT, with_term(sensors={"imu": "x"}), [f"{each} sensor imu x is new" for each in (A, B)]),
    "a term's name": (CONTRACT, with_term(name="a"), ["observation of critic 0: wheels/a is gone", "observation of critic 1: wheels/b is gone", "observation of critic 0: a is new", "observation of critic 1: a/b is new"]),
    "longer history": (CONTRACT, with_group(with_term(history=2), shape=(4,)), ["observation of critic 0: wheels/a (1 steps ago) is new", "observation of critic 1: wheels/b (1 steps ago) is new"]),
    "terms that one alone declares": (CONTRACT, with_group(CONTRACT, terms=()), []),
    "a shape of undeclared terms": (BARE, with_group(BARE, shape=(3,)), ["the observations of shape [2], float32, became [3], float32"]),
    "of another group": (with_group(CONTRACT, terms=()), with_group(CONTRACT, terms=(), dtype="uint8"), ["the observations of critic of shape [2], float32, became [2], uint8"]),
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
    "commands": (CONTRACT, with_command(name="b"), ["the command b is new", "the command go is gone"]),
    "a command's names": (CONTRACT, with_command(names=("w",), units=("1/s",)), ["command go: names [v] became [w]", "command go: units [m/s] became [1/s]"]),
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
    assert differences(before, CONTRACT) == differences(CONTRACT, before) == []
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
    assert differences(CONTRACT, with_command(seconds=(1.0, 3.0)), ranges=True) == [
        "command go: seconds [1.0, 2.0] became [1.0, 3.0]"
    ]


def test_a_group_is_found_by_its_name_and_up_to_five_differences_are_all_shown() -> None:
    assert CONTRACT.group("critic") is CONTRACT.groups[0] and CONTRACT.group("policy") is None
    assert brief(list("abcde")) == "a; b; c; d; e" and brief(list("abcdef")) == "a; b; c; d; e; and 1 more"
