"""Inverse kinematics to absolute positions and poses, in the root's frame and in the world's, against MuJoCo."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import mujoco
import numpy as np
import pytest
import torch

from tests.robots.worker.test_differential_ik import (
    ARM,
    ARM_POSITIONS,
    PLANAR,
    POSE,
    ArmConfig,
    Planar,
    Skew,
    damped,
    jacobian,
    made,
    refused,
    requested,
    tip,
    tip_jacobian,
    within,
)
from tests.support.worker.sensing import Reference
from worker.tasks import Action, DifferentialIK, Randomization, terms
from worker.tasks.run.policy_contract import policy_contract

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


def test_the_palm_arrives_at_the_pose_and_stays_there() -> None:
    weightless = ArmConfig(randomize=Randomization(gravity=(0.0, 0.0)))
    task = Posed(weightless, 2, seed=3)
    task.reset()
    requested(task, ARM_POSITIONS, np.zeros((2, 7)))  # worlds at these positions
    aims = [palm(positions) for positions in GOALS]
    targets = torch.tensor(np.array([[*place, *xyzw(turn)] for place, turn in aims]), dtype=torch.float32)
    for _ in range(60):
        task.step(targets)
    for row, (place, turn) in zip(task.observations.numpy(), aims, strict=True):
        reached, turned = palm(row)
        assert np.linalg.norm(reached - place) < 1e-3
        assert (np.trace(turn.T @ turned) - 1.0) / 2.0 > math.cos(0.002)


def test_without_a_quaternion_the_orientation_stays_as_it_is() -> None:
    task = made(Posed, max_step=5.0)
    place, turn = palm(ARM_POSITIONS[0])
    still = [[*place, 0.0, 0.0, 0.0, 0.0], [*palm(ARM_POSITIONS[1])[0], *xyzw(palm(ARM_POSITIONS[1])[1])]]
    assert abs(rotation_vector(turn)).max() > 0.1  # so that an identity would have turned it
    np.testing.assert_allclose(requested(task, ARM_POSITIONS, still), 0.0, atol=2e-5)


def test_one_action_held_brings_the_tip_to_its_place_seen_from_a_root_that_is_turned() -> None:
    free = type("Free", (Point,), {"text": PLANAR.replace('pos="0 0 1">', 'pos="0 0 1"><freejoint/>', 1)})
    task = made(free, damping=0.02)
    positions = np.array([(0, 0, 0, 0, 0, 0, 1, 0.4, 0.9, 0.02), (1, -2, 0.5, 0, 0, 0.6, 0.8, 0.4, 0.9, 0.02)])
    aim = tip((0.4, 0.9)) + np.array([-0.02, 0.01])
    found = requested(task, positions, np.tile([*aim, 0.0], (2, 1)), joints=[7, 8, 9])[:, :2]
    expected = damped(tip_jacobian(), (-0.02, 0.01), damping=0.02)
    np.testing.assert_allclose(found, np.tile(expected, (2, 1)), atol=1e-4)


def test_the_contract_names_numbers_of_a_pose_and_their_units() -> None:
    task = made(Posed, frame="world")
    actions = policy_contract(task, "Posed").actions
    assert [action.name for action in actions] == [f"palm_{axis}" for axis in FULL]
    assert [action.unit for action in actions] == ["m"] * 3 + ["1"] * 4
    assert "one number of its wanted pose" in actions[0].rule
    assert "bring the site palm in the world's frame to x, y, z, qx, qy, qz, qw" in actions[0].rule


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"axes": ("x", "roll")}, "there is no axis 'roll'; there are x, y, z, qx, qy, qz, qw"),
        ({"axes": ("x", "qx", "qw")}, "axes has qx, qw; an orientation is qx, qy, qz, qw, in this order"),
        ({"axes": ("qw", "qx", "qy", "qz")}, "an orientation is qx, qy, qz, qw, in this order"),
        ({"frame": "wrld"}, "DifferentialIK.frame is 'wrld'; did you mean world?"),
        ({"absolute": False, "axes": ("x", "qw")}, "there is no axis 'qw'"),
        ({"from_targets": True}, "from_targets adds up movements; leave it out where absolute=True"),
    ],
)
def test_what_can_t_be_is_refused_in_one_line(options: dict[str, Any], message: str) -> None:
    output = refused(ik=replace(Point.ik, **options), actions=Point.actions)
    assert output.startswith("task Wrong: sensors.tip: DifferentialIK") and message in output


def test_a_part_of_an_absolute_target_is_refused_in_one_line() -> None:
    part = {"tip": Action(terms.move_frame, size=1), "grip": Point.actions["grip"]}
    output = refused(ik=Point.ik, actions=part)
    assert "actions.tip: size is 1, and an absolute target has 2 columns; leave size= out" in output


def test_scales_and_offsets_make_a_workspace_of_the_actions() -> None:
    scaled = {"tip": Action(terms.move_frame, scale={"*_x": 0.2, "*": 0.1}, offset={"*_x": 0.5, "*": 0.3})}
    kind = type("Scaled", (Point,), {"actions": scaled | {"grip": Point.actions["grip"]}})
    first, second, _ = policy_contract(kind(ArmConfig(), 1, seed=3), "Scaled").actions
    assert (first.scale, first.offset) == (pytest.approx(0.2), pytest.approx(0.5))
    assert (second.scale, second.offset) == (pytest.approx(0.1), pytest.approx(0.3))
