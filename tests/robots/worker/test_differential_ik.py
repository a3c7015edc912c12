"""Differential inverse kinematics against MuJoCo's own Jacobians and numpy, and arms that go where actions say."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
import warp as wp

from tests.support.refusals import refusal
from tests.support.worker.declared import Small, SmallConfig
from tests.support.worker.sensing import Reference
from worker.tasks import Action, DifferentialIK, PositionActuator, Robot, terms
from worker.tasks.compile.tables import tables
from worker.tasks.run.policy_contract import policy_contract

POSE = ("x", "y", "z", "roll", "pitch", "yaw")
SERVO = PositionActuator("*", stiffness=2000.0, damping=60.0)
PLANAR = """<mujoco><compiler angle="radian"/><option gravity="0 0 0"/><worldbody><body name="base" pos="0 0 1">
  <geom type="box" size="0.05 0.05 0.05" mass="1"/>
  <body name="upper"><joint name="shoulder" axis="0 0 1" range="-2.5 2.5" damping="1" armature="0.1"/>
    <geom type="capsule" fromto="0 0 0 0.5 0 0" size="0.03" mass="1"/>
    <body name="lower" pos="0.5 0 0"><joint name="elbow" axis="0 0 1" range="-2.5 2.5" damping="1" armature="0.1"/>
      <geom type="capsule" fromto="0 0 0 0.4 0 0" size="0.03" mass="1"/>
      <site name="tip" pos="0.4 0 0"/>
      <body name="finger" pos="0.4 0 0"><joint name="grip" type="slide" axis="0 1 0" range="-0.1 0.1"/>
        <geom type="sphere" size="0.01" mass="0.1"/></body></body></body></body></worldbody></mujoco>"""
"""Two links that turn about the vertical, 0.5 and 0.4 m long, and a finger."""
ARM = """<mujoco><compiler angle="radian"/><option gravity="0 0 0"/><worldbody><body name="base" pos="0.1 -0.2 0.3" quat="0.8 0.2 -0.4 0.4">
  <geom type="box" size="0.05 0.05 0.05" mass="1"/>
  <body name="b1" pos="0 0 0.2" euler="0.3 0 0"><joint name="j1" axis="0 0 1" pos="0.02 0 0"/><geom type="sphere" size="0.02" mass="1"/>
  <body name="b2" pos="0.1 0 0.1" euler="0 0.4 0"><joint name="j2" axis="0 1 0.2"/><geom type="sphere" size="0.02" mass="1"/>
  <body name="b3" pos="0.2 0 0.1"><joint name="j3" axis="1 0 0"/><geom type="sphere" size="0.02" mass="1"/>
  <body name="b4" pos="0.1 0.1 0.1"><joint name="j4" type="slide" axis="0.3 0 1" range="-0.3 0.3"/><geom type="sphere" size="0.02" mass="1"/>
  <body name="b5" pos="0.1 0 0.2" euler="0 0 0.7"><joint name="j5" axis="0 1 0" range="-1 0.4"/><geom type="sphere" size="0.02" mass="1"/>
  <body name="b6" pos="0 0.1 0.1"><joint name="j6" axis="1 0.5 0"/><geom type="sphere" size="0.02" mass="1"/>
  <body name="hand" pos="0 0 0.1" euler="0.2 0.1 0"><joint name="j7" axis="0 0 1"/><geom type="sphere" size="0.02" mass="1"/>
    <site name="palm" pos="0.05 0.02 0.1" euler="0.5 0.6 0.7"/>
  </body></body></body></body></body></body></body></body></worldbody></mujoco>"""
"""Six hinges and a slider, with skew axes, on a base that is turned."""
ARM_POSITIONS = ((0.3, -0.5, 0.8, 0.1, -0.6, 0.4, 1.1), (-1.2, 0.9, 0.2, -0.2, 0.3, -0.7, 0.0))
ENDS = np.array(
    [[np.inf, np.inf, np.inf, 0.3, 0.4, np.inf, np.inf], [-np.inf, -np.inf, -np.inf, -0.3, -1.0, -np.inf, -np.inf]]
)


@dataclass(frozen=True)
class ArmConfig(SmallConfig):
    control_hz: float = 20.0
    substeps: int = 10
    episode_seconds: float = 100.0


class Planar(Small):
    """The tip of two links moves in the plane."""

    config_type = ArmConfig
    solver_options = {"disable_contacts": True, "njmax": 12, "nconmax": 0, "integrator": "implicitfast"}
    text = PLANAR
    positions: Any = {"shoulder": 0.4, "elbow": 0.9, "grip": 0.02}
    ik = DifferentialIK(site="tip", joints=("shoulder", "elbow"), axes=("x", "y"))
    actions: Mapping[str, Action] = {
        "tip": Action(terms.move_frame, scale={"tip_x": 0.02, "*": 0.01}, kind="position"),
        "grip": Action(terms.position_target, joints="grip", kind="position"),
    }

    def robot(self, config: ArmConfig) -> Robot:
        return Robot(self.text, actuators=(SERVO,), joint_positions=self.positions)

    def sections(self) -> dict[str, Any]:
        return {"actions": self.actions, "sensors": {"tip": self.ik}}


class Skew(Planar):
    """Seven joints move the palm in all six directions."""

    text = ARM
    positions = {}
    ik = DifferentialIK(site="palm", axes=POSE)
    actions = {"palm": Action(terms.move_frame, clip=None, kind="position")}


def made(kind: type[Planar], worlds: int = 2, **options: Any) -> Any:
    """A task whose inverse kinematics have other options."""
    changed = type(kind.__name__, (kind,), {"ik": replace(kind.ik, **options)})
    task = changed(ArmConfig(), worlds, seed=3)
    task.reset()
    return task


def continues_alike(one: Any, other: Any, action: torch.Tensor) -> bool:
    """Whether a task that takes over the state of another one does as that does."""
    for _ in range(3):
        one.step(action)
    other.load_state_dict(one.state_dict())
    for task in (one, other):
        for _ in range(3):
            task.step(action)
    return torch.equal(one.observations, other.observations)


def requested(task: Any, positions: Any, targets: Any, joints: Any = slice(None)) -> np.ndarray:
    """How far the joints' targets are from the joints, worlds being at these positions, shape ``(worlds, joints)``."""
    state = task.state_dict()
    state["joint_q"][:] = torch.tensor(positions)
    task.load_state_dict(state)
    task.step(torch.tensor(targets, dtype=torch.float32))
    return task.worlds.arrays.controls.numpy() - np.array(positions)[:, joints]


def jacobian(text: str, positions: Any, site: str | None = None, body: str | None = None) -> np.ndarray:
    """MuJoCo's own, turned into the frame of the base, shape ``(6, joints)``."""
    reference = Reference(text)
    model, data = reference.model, reference.data
    data.qpos[:] = positions
    mujoco.mj_forward(model, data)
    both = np.zeros((2, 3, model.nv))
    if site is not None:
        mujoco.mj_jacSite(model, data, both[0], both[1], model.site(site).id)
    else:
        mujoco.mj_jacBody(model, data, both[0], both[1], model.body(body).id)
    base = data.body("base").xmat.reshape(3, 3)
    return (base.T @ both).reshape(6, model.nv)


def damped(moves: np.ndarray, expected: Any, weights: Any = 1.0, damping: float = 0.05) -> np.ndarray:
    """How the joints move by damped least squares, of whose rows these are the weights."""
    weighed = moves.T * np.square(weights)
    found: np.ndarray = np.linalg.solve(weighed @ moves + damping**2 * np.eye(moves.shape[1]), weighed @ expected)
    return found


@pytest.mark.parametrize("place", [{"site": "palm", "body": None}, {"site": None, "body": "hand"}])
def test_the_joints_steps_are_those_of_mujoco_s_jacobian_and_numpy(place: dict[str, Any]) -> None:
    task = made(Skew, **place, position_weight=2.0, orientation_weight=0.5, damping=0.05, max_step=5.0)
    targets = np.array([[0.03, -0.02, 0.01, 0.05, -0.1, 0.02], [-0.01, 0.02, 0.05, -0.08, 0.0, 0.1]])
    found = requested(task, ARM_POSITIONS, targets)
    for world, positions in enumerate(ARM_POSITIONS):
        expected = damped(jacobian(ARM, positions, **place), targets[world], [2.0] * 3 + [0.5] * 3)
        assert np.abs(expected).max() > 0.02
        np.testing.assert_allclose(found[world], within(positions, expected), atol=1e-4)


def test_the_axes_are_those_of_a_root_that_is_free_and_turned() -> None:
    free = type("Free", (Planar,), {"text": PLANAR.replace('pos="0 0 1">', 'pos="0 0 1"><freejoint/>', 1)})
    turns = ((0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0), (1.0, -2.0, 0.5, 0.5, -0.1, 0.7, 0.5))
    positions = np.array([(*turn, 0.4, 0.9, 0.02) for turn in turns])
    positions[:, 3:7] /= np.linalg.norm(positions[:, 3:7], axis=1, keepdims=True)
    task = made(free, axes=("x", "y"))
    found = requested(task, positions, np.tile([0.5, 1.0, 0.0], (2, 1)), joints=[7, 8, 9])[:, :2]
    np.testing.assert_allclose(found, np.tile(damped(tip_jacobian(), [0.01, 0.01]), (2, 1)), atol=1e-4)


def test_axes_that_are_not_named_are_free_and_the_posture_draws() -> None:
    task = made(Skew, axes=("z", "pitch"), posture_weight=0.3, max_step=5.0)
    targets = np.array([[0.05, -0.1], [0.0, 0.0]])
    found = requested(task, ARM_POSITIONS, targets)
    for world, positions in enumerate(ARM_POSITIONS):
        moves = jacobian(ARM, positions, site="palm")[[2, 4]]
        left = moves.T @ moves + (0.0025 + 0.09) * np.eye(7)
        right = moves.T @ targets[world] - 0.09 * np.array(positions)
        np.testing.assert_allclose(found[world], within(positions, np.linalg.solve(left, right)), atol=1e-4)


def test_targets_keep_to_the_greatest_step_and_within_the_limits() -> None:
    task = made(Skew, max_step=0.07, soft_factor=0.5)
    positions = np.array(ARM_POSITIONS)
    found = requested(task, positions, np.full((2, 6), 5.0))
    half = ENDS.copy()
    half[:, 3:5] = [[0.15, 0.05], [-0.15, -0.65]]  # half of [-0.3, 0.3] and of [-1, 0.4] about their middles
    for world in range(2):
        moves = jacobian(ARM, positions[world], site="palm")
        steps = damped(moves, np.full(6, 5.0))
        assert np.abs(steps).max() > 0.07  # so that the greatest step counts
        expected = within(positions[world], np.clip(steps, -0.07, 0.07), half)
        np.testing.assert_allclose(found[world], expected, atol=1e-4)
    assert found[1, 4] == pytest.approx(0.05 - 0.3, abs=1e-5)  # beyond the soft limit: back at once


def test_a_joint_beyond_its_limits_is_drawn_back_and_the_others_do_their_part() -> None:
    # j5 is 0.3 beyond its 0.4; nothing is in the other world
    positions = (0.3, -0.5, 0.8, 0.1, 0.7, 0.4, 1.1), ARM_POSITIONS[0]
    task = made(Skew, limit_weight=3.0, max_step=5.0)
    found = requested(task, positions, np.zeros((2, 6)))
    moves, beyond = jacobian(ARM, positions[0], site="palm"), np.diag([0.0] * 4 + [9.0] + [0.0] * 2)
    expected = np.linalg.solve(moves.T @ moves + 0.0025 * np.eye(7) + beyond, beyond @ np.full(7, -0.3))
    expected[4] = -0.3  # whatever the equations say, the target is within the limits
    assert np.abs(expected[[0, 1, 2, 3, 5, 6]]).max() > 0.05
    np.testing.assert_allclose(found[0], expected, atol=1e-4)
    np.testing.assert_allclose(found[1], 0.0, atol=1e-6)


def within(positions: Any, steps: np.ndarray, ends: np.ndarray = ENDS) -> np.ndarray:
    """Steps that end within the limits of the joints."""
    return np.clip(np.array(positions) + steps, ends[1], ends[0]) - np.array(positions)


def tip(positions: Any) -> np.ndarray:
    """Where the planar arm's tip is, seen from its base."""
    reached = 0.5 * np.exp(1j * positions[0]) + 0.4 * np.exp(1j * (positions[0] + positions[1]))
    return np.array([reached.real, reached.imag])


def tip_jacobian() -> np.ndarray:
    """How it moves with shoulder and elbow, from where they are at the beginning."""
    x, y = tip((0.4, 0.9))
    elbow_x, elbow_y = 0.5 * math.cos(0.4), 0.5 * math.sin(0.4)
    return np.array([[-y, elbow_y - y], [x, x - elbow_x]])


class Heavy(Planar):
    """The planar arm upright: its joints turn about -y, from x to z, and its weight pulls it down."""

    text = PLANAR.replace('gravity="0 0 0"', 'gravity="0 0 -9.81"').replace('axis="0 0 1"', 'axis="0 -1 0"')
    ik = replace(Planar.ik, axes=("x", "z"))


def test_an_arm_that_goes_on_from_its_targets_holds_its_weight() -> None:
    sunk = {}
    for goes_on in (False, True):
        task = made(Heavy, worlds=1, from_targets=goes_on)
        begin = tip(task.observations[0].tolist())
        for _ in range(40):
            task.step(torch.zeros(1, 3))
        sunk[goes_on] = begin[1] - tip(task.observations[0].tolist())[1]
    assert sunk[False] > 0.05 and 0.0 < sunk[True] < 0.02


def test_targets_that_go_on_stay_near_the_joints_and_begin_anew_with_an_episode() -> None:
    task = made(Planar, worlds=1, from_targets=True, max_step=0.04, damping=0.01)
    begin = task.observations.clone()
    for _ in range(5):
        places = task.observations.numpy().copy()
        task.step(torch.tensor([[-1.0, 0.0, 0.0]]))
        far = np.abs(task.worlds.arrays.controls.numpy() - places)[:, :2]
        assert far.max() < 0.04 + 1e-5
    assert far.max() == pytest.approx(0.04, abs=1e-5)
    task.reset()
    task.step(torch.zeros(1, 3))
    np.testing.assert_allclose(task.worlds.arrays.controls.numpy()[:, :2], begin[:, :2], atol=1e-5)


@pytest.mark.parametrize("goes_on", [False, True], ids=["from the joints", "from the targets"])
def test_a_state_goes_on_bit_for_bit(goes_on: bool) -> None:
    one, other = made(Skew, from_targets=goes_on), made(Skew, from_targets=goes_on)
    action = torch.full((2, 6), 0.03)
    assert continues_alike(one, other, action)
    assert not wp.to_torch(one.sensors["tip"].arrays.target).any()


def test_actions_and_tables_and_the_contract_name_the_columns() -> None:
    task = made(Planar)
    assert task.action_names == ("tip_x", "tip_y", "grip")
    row, _ = tables(task.plan)["actions"]
    assert (row["of"], row["joints"], row["scale"]) == ("tip_x, tip_y", "shoulder, elbow", "0.01 to 0.02")
    first, second, grip = policy_contract(task, "Planar").actions
    assert (first.name, first.kind, first.unit, first.scale) == ("tip_x", "position", "m", pytest.approx(0.02))
    assert (second.scale, second.stiffness, second.clip) == (pytest.approx(0.01), 0.0, (-1.0, 1.0))
    assert first.rule.startswith("A displacement of a body or site")
    assert "position targets of shoulder, elbow" in first.rule
    assert "the site tip in the root's frame by x, y" in first.rule and "damping = 0.05" in first.rule
    assert grip.rule == ""
    fewer = type("Fewer", (Planar,), {"actions": {"tip": Action(terms.move_frame, size=1)}}).sketch(ArmConfig())
    assert fewer.action_names == ("tip_x",)


def refused(**changed: Any) -> str:
    return refusal(type("Wrong", (Planar,), changed).sketch, ArmConfig())


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"body": "lower"}, "DifferentialIK: give either body or site, and not both"),
        ({"site": "tipp"}, "no site of robot matches 'tipp'; did you mean tip?"),
        ({"axes": ("x", "rol")}, "DifferentialIK.axes: there is no axis 'rol'; did you mean roll?"),
        ({"axes": ("x", "x")}, "DifferentialIK.axes is ('x', 'x'); give some of x, y, z, roll, pitch, yaw, each once"),
        ({"damping": 0.0}, "DifferentialIK.damping is 0.0; use a finite number > 0"),
        ({"posture_weight": -1.0}, "DifferentialIK.posture_weight is -1.0; use a finite number >= 0"),
        ({"soft_factor": 1.5}, "DifferentialIK.soft_factor is 1.5; use a number > 0, at most 1"),
        ({"joints": "elbo"}, "no joint of robot matches 'elbo'; did you mean elbow?"),
        ({"joints": "*"}, "DifferentialIK.joints: grip does not move tip; those that do: shoulder, elbow"),
    ],
)
def test_what_can_t_be_is_refused_in_one_line(options: dict[str, Any], message: str) -> None:
    output = refused(ik=replace(Planar.ik, **options))
    assert output.startswith(f"task Wrong: sensors.tip: {message}")


def test_actions_that_do_not_fit_are_refused_in_one_line() -> None:
    move, grip = Planar.actions["tip"], Planar.actions["grip"]
    unasked = "task Wrong: sensors.tip: no action asks for it; declare one, such as Action(terms.move_frame)"
    assert refused(actions={"grip": grip}) == unasked
    assert "column tip_x is driven by two terms" in refused(actions={"one": move, "two": move, "grip": grip})
    both = replace(Planar.ik, site=None, body="finger", joints="*")
    driven = {"tip": Action(terms.move_frame, kind="position"), "grip": grip}
    assert "sensors.tip: joint grip is driven by two terms; each joint has one" in refused(ik=both, actions=driven)
    for options, output in (
        ({"size": 3}, "actions.tip: size is 3, more than the 2 columns of tip"),
        ({"offset": "default"}, 'offset="default" is for terms of joints'),
    ):
        assert output in refused(actions={"tip": Action(terms.move_frame, **options)})
    two = PLANAR.replace('<joint name="elbow"', '<joint name="twist" axis="1 0 0"/><joint name="elbow"')
    assert "elbow is one of several joints between the same two bodies" in refused(text=two)


def test_a_joint_without_an_actuator_is_refused_in_one_line() -> None:
    idle = Robot(PLANAR, actuators=(replace(SERVO, joints=("shoulder", "grip")),))
    output = refused(robot=lambda self, config: idle)
    assert "sensors.tip: joint elbow has no actuator; give the robot one" in output
