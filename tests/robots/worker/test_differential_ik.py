"""Inverse kinematics, by displacements and to absolute poses, against MuJoCo's own Jacobians and numpy."""

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


def test_actions_that_do_not_fit_are_refused_in_one_line() -> None:
    move, grip = Planar.actions["tip"], Planar.actions["grip"]
    unasked = "task Wrong: sensors.tip: no action asks for it; declare one, such as Action(terms.move_frame)"
    assert refused(actions={"grip": grip}) == unasked
    assert "column tip_x is driven by two terms" in refused(actions={"one": move, "two": move, "grip": grip})
    both = replace(Planar.ik, site=None, body="finger", joints="*")
    driven = {"tip": Action(terms.move_frame, kind="position"), "grip": grip}
    assert "sensors.tip: joint grip is driven by two terms; each joint has one" in refused(ik=both, actions=driven)
    for ik, options, output in (
        (Planar.ik, {"size": 3}, "actions.tip: size is 3, more than the 2 columns of tip"),
        (Planar.ik, {"offset": "default"}, 'offset="default" is for terms of joints'),
        (Point.ik, {"size": 1}, "actions.tip: size is 1, and an absolute target has 2 columns; leave size= out"),
    ):
        assert output in refused(ik=ik, actions={"tip": Action(terms.move_frame, **options), "grip": grip})
    two = PLANAR.replace('<joint name="elbow"', '<joint name="twist" axis="1 0 0"/><joint name="elbow"')
    assert "elbow is one of several joints between the same two bodies" in refused(text=two)
    idle = Robot(PLANAR, actuators=(replace(SERVO, joints=("shoulder", "grip")),))
    output = refused(robot=lambda self, config: idle)
    assert "sensors.tip: joint elbow has no actuator; give the robot one" in output


FULL = ("x", "y", "z", "qx", "qy", "qz", "qw")
GOALS = ((0.2, -0.7, 0.9, 0.05, -0.5, 0.2, 0.8), (-1.0, 0.8, 0.0, -0.1, 0.2, -0.4, 0.3))
"""Positions of the joints whose palm poses are the goals: near those of ``ARM_POSITIONS``."""


class Point(Planar):
    """The tip of two links goes to a place in the plane; an action of 1 is 1 m."""

    ik = DifferentialIK(site="tip", joints=("shoulder", "elbow"), axes=("x", "y"), absolute=True)
    actions: Mapping[str, Action] = {
        "tip": Action(terms.move_frame, kind="position"),
        "grip": Action(terms.position_target, joints="grip", kind="position"),
    }


class Posed(Skew):
    """The palm goes to a pose."""

    ik = DifferentialIK(site="palm", axes=FULL, absolute=True)


def palm(positions: Any, frame: str = "root") -> tuple[np.ndarray, np.ndarray]:
    """MuJoCo's position [m] and rotation matrix of the palm, seen from the base or from the world."""
    reference = Reference(ARM)
    data = reference.data
    data.qpos[:] = positions
    mujoco.mj_forward(reference.model, data)
    place, turn = data.site("palm").xpos.copy(), data.site("palm").xmat.reshape(3, 3).copy()
    if frame == "world":
        return place, turn
    base = data.body("base")
    base_turn = base.xmat.reshape(3, 3)
    return base_turn.T @ (place - base.xpos), base_turn.T @ turn


def base_rotation() -> np.ndarray:
    """The rotation matrix of the base of the seven-jointed arm."""
    reference = Reference(ARM)
    mujoco.mj_forward(reference.model, reference.data)
    return np.array(reference.data.body("base").xmat.reshape(3, 3))


def xyzw(turn: np.ndarray) -> np.ndarray:
    found = np.zeros(4)
    mujoco.mju_mat2Quat(found, turn.flatten())
    return found[[1, 2, 3, 0]]


def rotation_vector(turn: np.ndarray) -> np.ndarray:
    """Of a rotation matrix [rad], by its trace and its antisymmetric part."""
    angle = math.acos((np.trace(turn) - 1.0) / 2.0)
    parts = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    return parts * angle / (2.0 * math.sin(angle))


@pytest.mark.parametrize("frame", ["root", "world"])
def test_steps_to_a_pose_are_those_of_mujoco_s_jacobian_and_of_what_is_left_to_it(frame: str) -> None:
    task = made(Posed, frame=frame, position_weight=2.0, orientation_weight=0.5, max_step=5.0)
    aims = [palm(positions, frame) for positions in GOALS]
    lengths = (3.0, -0.5)  # of quaternions that need not have the length 1, and whose negative is the same rotation
    targets = [[*place, *(length * xyzw(turn))] for (place, turn), length in zip(aims, lengths, strict=True)]
    found = requested(task, ARM_POSITIONS, targets)
    for world, positions in enumerate(ARM_POSITIONS):
        place, turn = palm(positions, frame)
        left = np.concatenate((aims[world][0] - place, rotation_vector(aims[world][1] @ turn.T)))
        assert np.abs(left).min() > 1e-3
        moves = jacobian(ARM, positions, site="palm")
        if frame == "world":
            moves = np.kron(np.eye(2), base_rotation()) @ moves
        expected = damped(moves, left, [2.0] * 3 + [0.5] * 3)
        np.testing.assert_allclose(found[world], within(positions, expected), atol=2e-4)


def test_a_movement_along_the_world_s_axes_is_turned_from_one_along_the_root_s() -> None:
    task = made(Skew, axes=POSE, frame="world", max_step=5.0)
    targets = np.array([[0.03, -0.02, 0.01, 0.05, -0.1, 0.02], [-0.01, 0.02, 0.05, -0.08, 0.0, 0.1]])
    found = requested(task, ARM_POSITIONS, targets)
    base = np.kron(np.eye(2), base_rotation())
    for world, positions in enumerate(ARM_POSITIONS):
        expected = damped(base @ jacobian(ARM, positions, site="palm"), targets[world])
        np.testing.assert_allclose(found[world], within(positions, expected), atol=1e-4)


def test_without_a_quaternion_the_orientation_stays_as_it_is() -> None:
    task = made(Posed, max_step=5.0)
    place, turn = palm(ARM_POSITIONS[0])
    still = [[*place, 0.0, 0.0, 0.0, 0.0], [*palm(ARM_POSITIONS[1])[0], *xyzw(palm(ARM_POSITIONS[1])[1])]]
    assert abs(rotation_vector(turn)).max() > 0.1  # so that an identity would have turned it
    np.testing.assert_allclose(requested(task, ARM_POSITIONS, still), 0.0, atol=2e-5)


def test_the_contract_names_numbers_of_a_pose_and_their_units() -> None:
    task = made(Posed, frame="world")
    actions = policy_contract(task, "Posed").actions
    assert [action.name for action in actions] == [f"palm_{axis}" for axis in FULL]
    assert [action.unit for action in actions] == ["m"] * 3 + ["1"] * 4
    assert "one number of its wanted pose" in actions[0].rule
    assert "bring the site palm in the world's frame to x, y, z, qx, qy, qz, qw" in actions[0].rule


MOVED, ABSOLUTE = Planar.ik, Point.ik
REFUSED: Mapping[str, tuple[DifferentialIK, dict[str, Any]]] = {
    "DifferentialIK: give either body or site, and not both": (MOVED, {"body": "lower"}),
    "no site of robot matches 'tipp'; did you mean tip?": (MOVED, {"site": "tipp"}),
    "DifferentialIK.axes: there is no axis 'rol'; did you mean roll?": (MOVED, {"axes": ("x", "rol")}),
    "DifferentialIK.axes is ('x', 'x'); give some of x, y, z, roll, pitch, yaw, each": (MOVED, {"axes": ("x", "x")}),
    "DifferentialIK.damping is 0.0; use a finite number > 0": (MOVED, {"damping": 0.0}),
    "DifferentialIK.posture_weight is -1.0; use a finite number >= 0": (MOVED, {"posture_weight": -1.0}),
    "DifferentialIK.soft_factor is 1.5; use a number > 0, at most 1": (MOVED, {"soft_factor": 1.5}),
    "DifferentialIK.joints: grip does not move tip; those that do: shoulder, elbow": (MOVED, {"joints": "*"}),
    "DifferentialIK.axes: there is no axis 'qw'": (MOVED, {"axes": ("x", "qw")}),
    "DifferentialIK.axes: there is no axis 'roll'; available: x, y, z, qx": (ABSOLUTE, {"axes": ("x", "roll")}),
    "DifferentialIK.axes has qx, qw; an orientation is qx, qy, qz, qw, in": (ABSOLUTE, {"axes": ("x", "qx", "qw")}),
    "DifferentialIK.frame is 'wrld'; did you mean world?": (ABSOLUTE, {"frame": "wrld"}),
    "DifferentialIK.from_targets adds up movements; leave it out where absolute=True": (
        ABSOLUTE,
        {"from_targets": True},
    ),
}


@pytest.mark.parametrize("message", REFUSED)
def test_invalid_options_are_refused_in_one_line(message: str) -> None:
    ik, options = REFUSED[message]
    assert refused(ik=replace(ik, **options)).startswith(f"task Wrong: sensors.tip: {message}")
