"""The policy contract of a task: what the document says of its observations, commands and actions, and of a change of them."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
import warp as wp

from shared_store.contract.policy import Contract, read
from shared_store.contract.policy_changes import robot_changes
from tests.support.worker.declared import Sliders, SlidersConfig, TorchSliders
from worker.learning.algorithm import ExportedPolicy
from worker.learning.setup import check_contract
from worker.settings.errors import UserError
from worker.tasks import (
    Action,
    Declaration,
    EffortActuator,
    ExplicitPDActuator,
    Observation,
    PositionActuator,
    Reward,
    Robot,
    RobotArrays,
    Task,
    TaskConfig,
    VelocityActuator,
    WorldArrays,
    reward_weights,
    terms,
)
from worker.tasks.run.policy_contract import policy_contract

WORLDS = 4


@pytest.fixture(scope="module")
def sliders() -> Sliders:
    return Sliders(SlidersConfig(), WORLDS, seed=1)


def published(task: Any, exported: ExportedPolicy | None = None) -> Contract:
    return read(json.loads(json.dumps(policy_contract(task, type(task).__name__, exported).document())))


def test_a_term_s_function_and_numbers_are_in_the_contract(sliders: Sliders) -> None:
    contract = published(sliders)
    terms = {term.name: term for term in contract.groups[0].terms}
    place, late, target = terms["place"], terms["late"], terms["target"]
    assert (place.quantity, place.element, place.elements) == ("joint_position", "joint", ("first", "second"))
    assert (place.scale, place.offset) == ((2.0, 1.0), (0.5, 0.0)) and place.clip == pytest.approx((-0.8, 0.8))
    assert (late.first, late.size, late.history, late.delay) == (2, 3, 3, (0, 2))
    assert (target.kind, target.command, target.ranges, target.units) == ("command", "target", ((-1.0, 1.0),), ("m",))
    assert contract.groups[0].terms[-1].kind == "previous_action"
    force = contract.actions[0]
    assert (force.kind, force.scale, force.offset) == ("effort", 1.0, 0.5)
    assert (force.clip, force.effort_limit) == ((-2.0, 2.0), 2.0)
    (command,) = contract.commands
    assert (command.name, command.names, command.ranges) == ("target", ("place",), ((-1.0, 1.0),))
    assert command.seconds == pytest.approx((0.3, 0.5))
    assert contract.normalizer == "unknown" and [group.name for group in contract.groups] == ["policy", "critic"]
    assert [term.quantity for term in contract.groups[1].terms] == ["joint_position", "counted"]


def test_a_recurrent_policy_s_inputs_and_state_are_in_the_contract(sliders: Sliders) -> None:
    inputs = {"obs": torch.zeros(1, 3), "h": torch.zeros(1, 1, 8)}
    exported: Any = SimpleNamespace(sample={"critic": None}, inputs=inputs, states=["h"])
    contract = published(sliders, exported)
    assert [(group.name, group.input, group.shape) for group in contract.groups] == [("critic", "obs", (3,))]
    assert [(state.name, state.output, state.shape) for state in contract.states] == [("h", "h_out", (1, 8))]
    assert contract.normalizer == "inside"


def test_terms_in_torch_have_the_same_document_with_less() -> None:
    both = published(TorchSliders(SlidersConfig(), 1)).groups[0].terms[0]
    assert (both.names, both.quantity, both.element) == (("both_0", "both_1"), "both", "")


class Other(Sliders):
    """The same sizes, with another meaning."""

    def sections(self) -> dict[str, Any]:
        sections = super().sections()
        sections["observations"]["policy"]["place"].scale = (1.0, 1.0)
        sections["actions"]["force"].clip = (-1.0, 1.0)
        return sections


def checkpoint(task: Any, **facts: Any) -> Any:
    sizes = {name: list(group.shape[1:]) for name, group in task.groups.items()}
    manifest = {"task": "Sliders", "policy": {"groups": sizes, "action_size": 2}, **facts}
    return SimpleNamespace(name="00000004-e1", path=Path("nowhere"), manifest=manifest)


def test_a_checkpoint_whose_task_changed_is_refused_with_the_change(sliders: Sliders) -> None:
    then = checkpoint(sliders, contract=published(sliders).document())
    check_contract(then, sliders, {})
    with pytest.raises(UserError) as caught:
        check_contract(then, Other(SlidersConfig(), 1), {})
    output = str(caught.value)
    assert output.startswith(
        "checkpoint 00000004-e1 does not fit task Sliders as it is now: observation 0: place/first_place scale 2.0 became 1.0; "
    )
    assert "action 0: first clip [-2.0, 2.0] became [-1.0, 1.0]" in output and "\n" not in output


def test_of_a_checkpoint_without_a_contract_sizes_are_compared(sliders: Sliders) -> None:
    accepted = {"accept_changed_robot": True}  # that the file's gravity counts by now
    check_contract(checkpoint(sliders), Other(SlidersConfig(), 1), accepted)
    wider = checkpoint(sliders)
    wider.manifest["policy"]["groups"]["policy"] = [10]
    with pytest.raises(UserError, match=r"does not fit task Sliders as it is now: it had .*\(10,\).*, it has .*\(9,\)"):
        check_contract(wider, sliders, accepted)


def test_a_change_of_a_robot_is_named_by_its_element(sliders: Sliders) -> None:
    (robot,) = published(sliders).robots
    body, *_ = [name for name in robot.elements if name.startswith("body ")]
    joint, *_ = [name for name in robot.elements if name.startswith("joint ")]
    changed = {
        **robot.elements,
        body: {**robot.elements[body], "mass": 7.5},
        joint: {**robot.elements[joint], "armature": 0.25},
        "actuator more": {},
    }
    then = dataclasses.replace(robot, digest="0" * 64, elements={**changed, "weld x": {}})
    del then.elements["model"]  # as in a contract that does not hold all kinds
    mass = robot.elements[body]["mass"]
    assert robot_changes([then], [robot]) == [
        f"robot: {body}: mass 7.5 became {mass:g}; {joint}: armature 0.25 became 0; actuator more is gone"
    ]
    assert robot_changes([dataclasses.replace(then, elements={})], [robot]) == [
        "robot: other values of its compiled model changed"
    ]


def test_a_policy_of_an_older_muster_was_trained_on_what_newton_s_importer_read(sliders: Sliders) -> None:
    document = published(sliders).document()
    del document["robots"]
    with pytest.raises(UserError, match=r"robot: option: gravity was .*, is \(0 0 0\)"):
        check_contract(checkpoint(sliders, contract=document | {"format": 3}), sliders, {})


def test_a_damaged_contract_in_a_checkpoint_is_one_line(sliders: Sliders) -> None:
    document = published(sliders).document()
    del document["control_hz"]
    with pytest.raises(UserError, match=r"^checkpoint 00000004-e1: contract: control_hz is missing$"):
        check_contract(checkpoint(sliders, contract=document), sliders, {})


LIMITED = """<mujoco><compiler angle="radian"/><option gravity="0 0 0"/><worldbody><body name="near" pos="0 0 1">
  <joint name="first" type="hinge" axis="0 0 1" range="-3 1" limited="true"/>
  <geom type="sphere" size="0.1" mass="1" pos="0.5 0 0" contype="0" conaffinity="0"/>
  <body name="far" pos="1 0 0">
    <joint name="second" type="slide" axis="1 0 0" range="0 2" limited="true"/>
    <geom type="sphere" size="0.1" mass="1" contype="0" conaffinity="0"/>
  </body></body></worldbody></mujoco>"""


SERVO = PositionActuator("*", 20.0, 0.5)


@dataclass(frozen=True)
class DrivenConfig(TaskConfig):
    control_hz: float = 50.0
    substeps: int = 4
    episode_seconds: float = 1.0
    rewards: Mapping[str, float] = reward_weights(alive=1.0)


def driven_by(function: Any, *actuators: Any, **options: Any) -> list[dict[str, Any]]:
    """The actions of the contract of a task whose robot is driven so."""

    class Driven(Task):
        config_type = DrivenConfig

        def robot(self, config: DrivenConfig) -> Robot:
            return Robot(LIMITED, actuators=actuators)

        def declare(self, config: DrivenConfig) -> Declaration:
            return Declaration(
                actions={"drive": Action(function, **options)},
                observations={"policy": {"place": Observation(terms.joint_position)}},
                rewards={"alive": Reward(terms.alive)},
            )

    found: list[dict[str, Any]] = published(Driven(DrivenConfig(), 2, seed=1)).document()["actions"]
    return found


def test_gains_of_a_motor_whose_force_is_computed_are_its_own() -> None:
    motor = ExplicitPDActuator("*", {"first": 20.0, "second": 30.0}, 0.5, effort_limit=4.0)
    first, second = driven_by(terms.position_target, motor, kind="position", scale=0.25)
    gains = [(each["stiffness"], each["damping"], each["effort_limit"]) for each in (first, second)]
    assert gains == [(20.0, 0.5, 4.0), (30.0, 0.5, 4.0)]
    assert (first["scale"], first["unit"], second["unit"], first["rule"]) == (0.25, "rad", "m", "")


def test_a_share_of_a_range_becomes_scale_and_offset_within_limits() -> None:
    """value = 0.5 a + 0.2, within ±1, is a share of [-3, 1]: the target is -1 + 2 value."""
    options: dict[str, Any] = {"kind": "position", "scale": 0.5, "offset": 0.2, "clip": (-2.0, 2.0)}
    first, second = driven_by(terms.share_of_range_target, SERVO, **options)
    assert (first["scale"], first["offset"]) == pytest.approx((1.0, -0.6))
    assert (second["scale"], second["offset"]) == pytest.approx((0.5, 1.2))
    assert first["clip"] == pytest.approx([-2.0, 1.6]) and first["rule"] == ""


def test_a_rule_beyond_scale_and_offset_is_given_in_words() -> None:
    first, _ = driven_by(terms.smoothed_position_target, SERVO, kind="position", share=0.25)
    assert first["rule"].startswith("A position target that follows ``value`` slowly: t = share * value")
    assert first["rule"].endswith("(share = 0.25)")


@wp.func
def press(world: int, worlds: WorldArrays, robot: RobotArrays, joint: int, value: float):
    worlds.controls[world, robot.actuators[joint]] = 2.0 * value


@pytest.mark.parametrize(
    ("function", "actuator", "kind", "unit"),
    [
        (terms.position_target, SERVO, "position", "rad"),
        (terms.position_target, ExplicitPDActuator("*", 20.0, 0.5), "position", "rad"),
        (terms.velocity_target, VelocityActuator("*", 0.5), "velocity", "rad/s"),
        (terms.effort, EffortActuator("*"), "effort", "N m"),
        (press, SERVO, "position", "rad"),
    ],
)
def test_an_action_is_what_its_function_writes_or_else_what_its_actuators_take(
    function: Any, actuator: Any, kind: str, unit: str
) -> None:
    first, _ = driven_by(function, actuator)
    assert (first["kind"], first["unit"]) == (kind, unit)


@pytest.mark.parametrize(
    ("function", "actuator", "kind", "writes", "takes", "another"),
    [
        (terms.effort, SERVO, None, "an effort", "a position", "an EffortActuator"),
        (terms.position_target, EffortActuator("*"), None, "a position", "an effort", "a PositionActuator"),
        (press, SERVO, "velocity", "a velocity", "a position", "a VelocityActuator"),
    ],
)
def test_an_action_that_its_actuators_do_not_take_is_refused(
    function: Any, actuator: Any, kind: str | None, writes: str, takes: str, another: str
) -> None:
    with pytest.raises(ValueError) as refused:
        driven_by(function, actuator, **({"kind": kind} if kind else {}))
    use = {"a position": "terms.position_target", "an effort": "terms.effort"}[takes]
    words = f"writes {writes}, and the actuator of joint first takes {takes}; use {use}, or give the joint {another}"
    assert str(refused.value).endswith(f"actions.drive: {function.func.__name__} {words}")


def test_the_kind_of_an_action_is_what_its_function_writes() -> None:
    with pytest.raises(ValueError, match=r"kind is 'effort', and position_target writes a position; leave kind= out$"):
        driven_by(terms.position_target, SERVO, kind="effort")


def test_an_action_of_ones_own_for_actuators_that_take_different_things_is_refused() -> None:
    existing = "the actuators of its joints take a position and a velocity; declare an action for each"
    with pytest.raises(ValueError, match=existing):
        driven_by(press, PositionActuator("first", 20.0, 0.5), VelocityActuator("second", 0.5))
