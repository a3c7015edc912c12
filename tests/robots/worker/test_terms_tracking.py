"""Terms of manipulation and of following a motion, judged by numpy; what a motion's file must hold."""

from __future__ import annotations

import re
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
import warp as wp

from tests.support.refusals import refusal
from tests.support.worker.terms_rig import (
    BODIES,
    JOINTS,
    OBJECT,
    OBJECT_DOF,
    ROOT,
    ROOT_DOF,
    WORLDS,
    Rig,
    array,
    close,
    matrix,
    rotations,
    terms_of,
)
from worker.simulation.sensors.frames import FrameArrays
from worker.tasks.terms.more.frame_sampling import AdaptiveSampling, FrameSampling
from worker.tasks.terms.more.motion import Motion, MotionArrays

COMMAND, FRAMES, FOLLOWED, ANCHOR = 10, 8, [1, 4, 5], 2
near = partial(close, rtol=5e-4, atol=5e-5)


def angle(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Angle between two rotations."""
    trace = np.trace(np.swapaxes(first, -1, -2) @ second, axis1=-2, axis2=-1)
    return np.arccos(np.clip((trace - 1) / 2, -1, 1))


def motion() -> MotionArrays:
    random = np.random.default_rng(8)
    arrays = MotionArrays()
    arrays.joint_positions = array(random.uniform(-0.1, 0.1, (FRAMES, JOINTS)))
    arrays.joint_velocities = array(random.normal(size=(FRAMES, JOINTS)))
    for name in ("positions", "linear", "angular"):
        setattr(arrays, name, array(random.normal(size=(FRAMES, 3, 3)), wp.vec3))
    for name in ("root_linear", "root_angular"):
        setattr(arrays, name, array(random.normal(size=(FRAMES, 3)), wp.vec3))
    arrays.rotations = array(rotations(random, FRAMES, 3), wp.quat)
    arrays.roots = array(np.hstack([random.normal(size=(FRAMES, 3)), rotations(random, FRAMES)]), wp.transform)
    arrays.bodies, arrays.anchor, arrays.rate = array(FOLLOWED, wp.int32), ANCHOR, 1.5
    arrays.sampling = FrameSampling(None, 1.0, WORLDS, "cpu").arrays
    return arrays


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Rig:
    random = np.random.default_rng(6)
    hand = FrameArrays()
    hand.positions = array(random.normal(size=(WORLDS, 2, 3)), wp.vec3)
    hand.rotations = array(rotations(random, WORLDS, 2), wp.quat)
    functions = terms_of("manipulation", "tracking", "following")
    made = Rig(functions, tmp_path_factory.mktemp("tracking"), {FrameArrays: hand, MotionArrays: motion()})
    values = made.episodes.memory.numpy()
    values[:, COMMAND + 3 : COMMAND + 7] = rotations(random, WORLDS)
    values[:, 0] = [0.0, 3.7, 99.0]  # frames: the first, the fourth, behind the last
    made.episodes.memory.assign(values)
    return made


@pytest.fixture
def rig(made: Rig) -> Iterator[Rig]:
    with made.kept():
        yield made


def test_terms_of_manipulation(rig: Rig) -> None:
    hand = rig.structs[FrameArrays].positions.numpy()[:, 0].astype(float)
    hand_turn = matrix(rig.structs[FrameArrays].rotations.numpy()[:, 0])
    here, item = rig.q[:, ROOT : ROOT + 3].astype(float), rig.q[:, OBJECT : OBJECT + 3].astype(float)
    base, item_turn = matrix(rig.q[:, ROOT + 3 : ROOT + 7]), matrix(rig.q[:, OBJECT + 3 : OBJECT + 7])
    memory = rig.episodes.memory.numpy().astype(float)
    target, expected_turn = memory[:, COMMAND : COMMAND + 3], base @ matrix(memory[:, COMMAND + 3 : COMMAND + 7])
    place = here + np.einsum("wij,wj->wi", base, target)

    def inside(way: np.ndarray, turn: np.ndarray = base) -> np.ndarray:
        return np.einsum("wji,wj->wi", turn, way)

    call, c = rig.call, {"command": COMMAND}
    near(call("object_position_in_root"), inside(item - here))
    near(matrix(call("object_orientation_in_root")), np.swapaxes(base, 1, 2) @ item_turn)
    near(call("object_velocity_in_root"), inside(rig.qd[:, OBJECT_DOF : OBJECT_DOF + 3]))
    near(call("hand_to_object"), inside(item - hand))
    near(call("object_to_target", **c), inside(target - item))
    near(call("target_in_hand", **c), inside(target - hand, hand_turn))
    near(call("target_in_root", **c), inside(target - here))
    reach, bring = np.linalg.norm(item - hand, axis=1), np.linalg.norm(target - item, axis=1)
    near(call("hand_object_distance", robot=rig.other), reach)
    near(call("object_target_distance", robot=rig.other, **c), bring)
    near(call("reach_object", robot=rig.other, std=2.0), np.exp(-((reach / 2) ** 2)))
    near(call("near_object", robot=rig.other, std=2.0), 1 - np.tanh(reach / 2))
    near(call("bring_object", robot=rig.other, std=2.0, **c), np.exp(-((bring / 2) ** 2)))
    staged = np.exp(-((reach / 2) ** 2)) * (1 + np.exp(-((bring / 3) ** 2)))
    near(call("reach_and_bring_object", robot=rig.other, reaching_std=2.0, bringing_std=3.0, **c), staged)
    high = item[:, 2] > np.median(item[:, 2])
    height = float(np.median(item[:, 2])) + 1e-4
    near(call("object_lifted", robot=rig.other, height=height), high)
    far = np.linalg.norm(place - item, axis=1)
    near(call("lifted_object_near_command", std=2.0, height=height, **c), high * (1 - np.tanh(far / 2)))
    limit = float(np.median(bring)) + 1e-4
    near(call("object_at_target", robot=rig.other, distance=limit, **c), bring < limit)
    near(call("object_reached_command", distance=float(np.median(far)) + 1e-4, **c), far <= np.median(far))
    reached = np.linalg.norm(place - hand, axis=1)
    near(call("hand_command_distance", **c), reached)
    near(call("hand_near_command", std=2.0, **c), 1 - np.tanh(reached / 2))
    near(call("hand_command_turn", **c), angle(expected_turn, hand_turn))
    near(call("object_command_turn", **c), angle(expected_turn, item_turn))

    numbers = rig.episodes.memory.numpy()
    numbers[:, 20] = [0.0, 1.0, 0.0]  # the second was there before
    rig.episodes.memory.assign(numbers)
    for _ in range(2):
        found = call("object_was_at_target", robot=rig.other, memory=20, distance=limit, **c)
        near(found, (bring < limit) | np.array([False, True, False]))


def test_terms_of_following_a_motion(rig: Rig) -> None:
    m = rig.structs[MotionArrays]
    frame = [0, 3, FRAMES - 1]
    requested, expected_turn = m.positions.numpy()[frame].astype(float), matrix(m.rotations.numpy()[frame])
    poses, velocities = rig.bodies.poses.numpy()[:, FOLLOWED].astype(float), rig.bodies.velocities.numpy()[:, FOLLOWED]
    here, turn = poses[..., :3], matrix(poses[..., 3:])
    arms = np.einsum("wbij,wbj->wbi", turn, rig.bodies.coms.numpy()[:, FOLLOWED])
    linear = velocities[..., :3] - np.cross(velocities[..., 3:], arms)
    anchor, anchor_turn = here[:, ANCHOR], turn[:, ANCHOR]
    back = np.swapaxes(anchor_turn, 1, 2)

    near(rig.call("motion_over", command=0), [0, 0, 1])
    for joint in range(JOINTS):
        near(rig.call("wanted_joint_position", joint, command=0), m.joint_positions.numpy()[frame, joint])
        near(rig.call("wanted_joint_velocity", joint, command=0), m.joint_velocities.numpy()[frame, joint])
    way = requested[:, ANCHOR] - anchor
    near(rig.call("wanted_anchor_position", command=0), np.einsum("wij,wj->wi", back, way))
    for index in range(6):
        elements = (back @ expected_turn[:, ANCHOR])[:, :, :2].reshape(WORLDS, 6)
        near(rig.call("wanted_anchor_turn", index, command=0), elements[:, index])
    for body in range(3):
        near(rig.call("followed_body_position", body), np.einsum("wij,wj->wi", back, here[:, body] - anchor))
        elements = (back @ turn[:, body])[:, :, :2].reshape(WORLDS, 6)
        for index in range(6):
            near(rig.call("followed_body_turn", 6 * body + index), elements[:, index])

    # relative references: carried to the robot's anchor along x and y and about the vertical
    between = anchor_turn @ np.swapaxes(expected_turn[:, ANCHOR], 1, 2)
    yaw = np.arctan2(between[:, 1, 0], between[:, 0, 0])
    about = np.zeros((WORLDS, 3, 3))
    about[:, 0, 0] = about[:, 1, 1] = np.cos(yaw)
    about[:, 1, 0], about[:, 0, 1], about[:, 2, 2] = np.sin(yaw), -np.sin(yaw), 1.0
    origin = np.concatenate([anchor[:, :2], requested[:, ANCHOR, 2:]], axis=1)
    relative = origin[:, None] + np.einsum("wij,wbj->wbi", about, requested - requested[:, ANCHOR, None])
    error, turned = relative - here, angle(about[:, None] @ expected_turn, turn)
    distance, anchor_angle = np.linalg.norm(error, axis=-1), angle(expected_turn[:, ANCHOR], anchor_turn)
    for name, squares in {
        "follow_anchor_position": (way**2).sum(1),
        "follow_anchor_turn": anchor_angle**2,
        "follow_body_positions": (distance**2).mean(1),
        "follow_body_turns": (turned**2).mean(1),
        "follow_body_velocities": ((linear - m.linear.numpy()[frame]) ** 2).sum(-1).mean(1),
        "follow_body_turning": ((velocities[..., 3:] - m.angular.numpy()[frame]) ** 2).sum(-1).mean(1),
    }.items():
        near(rig.call(name, command=0, std=2.0), np.exp(-squares / 4), name)
    near(rig.call("anchor_distance", command=0), np.linalg.norm(way, axis=1))
    near(rig.call("anchor_turn_error", command=0), anchor_angle)
    near(rig.call("mean_body_distance", command=0), np.linalg.norm(requested - here, axis=-1).mean(1))
    near(rig.call("mean_relative_body_distance", command=0), distance.mean(1))
    near(rig.call("mean_relative_body_turn", command=0), turned.mean(1))
    tilt = np.abs(expected_turn[:, ANCHOR, 2, 2] - anchor_turn[:, 2, 2])
    for name, values in (
        ("anchor_too_far", np.linalg.norm(way, axis=1)),
        ("anchor_height_off", np.abs(way[:, 2])),
        ("anchor_tilt_off", tilt),
    ):
        limit = float(np.sort(values)[1:].mean())
        near(rig.call(name, command=0, limit=limit), values > limit, name)
    for body in range(3):
        for name, values in (("followed_body_too_far", distance), ("followed_body_height_off", np.abs(error[..., 2]))):
            limit = float(np.median(values)) + 1e-3
            near(rig.call(name, body, command=0, limit=limit), values[:, body] > limit, name)
    q, qd = rig.q[:, rig.robot.coordinates.numpy()], rig.qd[:, rig.robot.dofs.numpy()]
    lag = np.linalg.norm(q - m.joint_positions.numpy()[frame], axis=1)
    near(rig.call("joint_position_error_norm", command=0), lag)
    speed = np.sqrt(((qd - m.joint_velocities.numpy()[frame]) ** 2).mean(1))
    near(rig.call("joint_velocity_error", command=0), speed)


def test_a_robot_begins_in_a_frame_of_the_motion_and_goes_on(rig: Rig) -> None:
    m, seen = rig.structs[MotionArrays], set()
    for seed in range(30):
        rig.call("motion_command", command=0, stream=seed)
        frames = rig.episodes.memory.numpy()[:, 0].astype(int)
        seen |= set(frames.tolist())
        q, qd = rig.worlds.joint_q.numpy(), rig.worlds.joint_qd.numpy()
        near(q[:, ROOT : ROOT + 7], m.roots.numpy()[frames])
        limited = np.clip(m.joint_positions.numpy()[frames], *rig.robot.ranges.numpy().T)
        near(q[:, rig.robot.coordinates.numpy()], limited)
        near(qd[:, rig.robot.dofs.numpy()], m.joint_velocities.numpy()[frames])
        coms = rig.bodies.coms.numpy()[:, rig.robot.root_body]
        arm = np.einsum("wij,wj->wi", matrix(q[:, ROOT + 3 : ROOT + 7]), coms)
        angular = qd[:, ROOT_DOF + 3 : ROOT_DOF + 6]
        near(angular, m.root_angular.numpy()[frames])
        near(qd[:, ROOT_DOF : ROOT_DOF + 3] - np.cross(angular, arm), m.root_linear.numpy()[frames])
    assert seen == set(range(FRAMES))
    rig.call("motion_command", command=0, stream=1, from_start=True, position=(0.0, 0.0, 0.5), joints=0.05)
    assert not rig.episodes.memory.numpy()[:, 0].any()
    moved = rig.worlds.joint_q.numpy()[:, ROOT : ROOT + 3] - m.roots.numpy()[0, :3]
    near(moved[:, :2], np.zeros((WORLDS, 2)))
    assert (np.abs(moved[:, 2]) <= 0.5).all() and np.ptp(moved[:, 2]) > 0.01
    for _ in range(3):
        rig.call("advance_motion", command=0)
    near(rig.episodes.memory.numpy()[:, 0], [4.5] * WORLDS)


def _file(folder: Path, **changed: Any) -> Path:
    random = np.random.default_rng(2)
    shapes = {"joint_pos": (6, JOINTS), "joint_vel": (6, JOINTS), "body_quat_w": (6, BODIES, 4)}
    shapes |= {name: (6, BODIES, 3) for name in ("body_pos_w", "body_lin_vel_w", "body_ang_vel_w")}
    data = {name: random.normal(size=shape) for name, shape in shapes.items()} | {"fps": np.array([50])} | changed
    path = folder / "motion.npz"
    np.savez(path, **{name: value for name, value in data.items() if value is not None})
    return path


def _context() -> Any:
    names = [f"body_{number}" for number in range(BODIES)]

    def find(pattern: Any) -> list[int]:
        requested = [pattern] if isinstance(pattern, str) else pattern
        return [index for index, name in enumerate(names) if name in requested]

    view = SimpleNamespace(
        joint_names=["j"] * JOINTS, body_names=names, bodies=list(range(3, 3 + BODIES)), find_bodies=find
    )
    worlds = SimpleNamespace(world_count=WORLDS)
    return SimpleNamespace(device="cpu", control_hz=25.0, view=lambda name, what: view, worlds=worlds)


def test_a_motion_is_read_from_its_file(tmp_path: Path) -> None:
    path = _file(tmp_path)
    built = Motion(path, bodies=["body_2", "body_5"], anchor="body_5").build(_context())
    data, arrays = np.load(path), built.arrays
    assert built.names == ("body_2", "body_5") and arrays.anchor == 1 and arrays.rate == 2.0
    assert arrays.bodies.numpy().tolist() == [5, 8]
    near(arrays.positions.numpy(), data["body_pos_w"][:, [2, 5]])
    near(arrays.rotations.numpy(), data["body_quat_w"][:, [2, 5]][..., [1, 2, 3, 0]])
    near(arrays.angular.numpy(), data["body_ang_vel_w"][:, [2, 5]])
    near(arrays.roots.numpy()[:, 3:], data["body_quat_w"][:, 0][:, [1, 2, 3, 0]])
    near(arrays.joint_velocities.numpy(), data["joint_vel"])


@pytest.mark.parametrize(
    ("changed", "output"),
    [
        ({"joint_vel": None}, r"motion.npz has no array joint_vel; it has .*joint_pos"),
        ({"joint_pos": np.zeros((6, 2))}, r"joint_pos of .* has the shape \(6, 2\); the robot has 5 joints and 7"),
        ({"body_pos_w": np.full((6, BODIES, 3), np.nan)}, r"body_pos_w of .* has numbers that are not finite"),
        ({"fps": np.array([0.0])}, r"fps of .* must be one number above 0"),
    ],
)
def test_a_wrong_motion_is_refused_in_one_line(tmp_path: Path, changed: dict[str, Any], output: str) -> None:
    motion = Motion(_file(tmp_path, **changed), bodies=["body_2"], anchor="body_2")
    assert re.search(output, refusal(motion.build, _context()))


def test_a_motion_that_is_not_there_or_has_another_anchor(tmp_path: Path) -> None:
    nothing, file = tmp_path / "nothing.npz", _file(tmp_path)
    for path, anchor, output in (
        (nothing, "body_2", f"Motion.file: {nothing} can't be read as a NumPy archive"),
        (file, "body_1", "Motion.anchor: name one of the bodies that are followed, not 'body_1'; body_2"),
    ):
        assert output in refusal(Motion(path, bodies=["body_2"], anchor=anchor).build, _context())


def test_frames_behind_which_worlds_failed_become_likelier() -> None:
    declaration = AdaptiveSampling(seconds=2.0, even=0.5, rate=0.25, reach=2, decay=0.5)
    sampling = FrameSampling(declaration, 7.0, WORLDS, "cpu")  # four parts
    near(sampling.arrays.likely.numpy(), [0.25, 0.5, 0.75, 1.0])
    state = sampling.state_tensors()
    state["failed"].copy_(torch.tensor([2, 2, 0]))
    sampling.advance()
    assert state["failed"].tolist() == [-1, -1, -1]
    state["failed"].copy_(torch.tensor([-1, 3, -1]))
    sampling.advance()
    failures = np.array([0.25 * 0.75, 0.0, 2 * 0.25 * 0.75, 0.25])
    near(state["failures"].numpy().sum(0), failures)
    own = failures + 0.5 / 4
    reached = own + 0.5 * own[[1, 2, 3, 3]]
    requested = reached / reached.sum()
    near(sampling.arrays.likely.numpy(), np.cumsum(requested))
    near(sampling.arrays.evenness.numpy(), [-(requested * np.log(requested)).sum() / np.log(4)])


def test_failures_on_other_ranks_count_as_those_of_a_rank_itself() -> None:
    declaration = AdaptiveSampling(seconds=2.0, even=0.1, rate=0.25)
    one, other = (FrameSampling(declaration, 7.0, 2, "cpu") for _ in range(2))
    for sampling, failed in ((one, [2, 2]), (other, [0, 3])):
        sampling.state_tensors()["failed"].copy_(torch.tensor(failed))
        sampling.advance()
    assert one.own_failures().tolist() == [0, 0, 500_000_000, 0]
    assert other.own_failures().tolist() == [250_000_000, 0, 0, 250_000_000]
    one.take_failures(other.own_failures())
    one.advance()
    failures = np.array([0.25, 0.0, 0.75 * 0.5, 0.25]) + 0.1 / 4
    near(one.arrays.likely.numpy(), np.cumsum(failures / failures.sum()))


@pytest.mark.parametrize("changed", [{"seconds": 0.0}, {"even": 0.0}, {"rate": 1.5}, {"reach": 0}, {"decay": -1.0}])
def test_a_wrong_sampling_is_refused_in_one_line(changed: dict[str, Any], tmp_path: Path) -> None:
    name, value = next(iter(changed.items()))
    motion = Motion(_file(tmp_path), bodies=["body_2"], anchor="body_2", sampling=AdaptiveSampling(**changed))
    output = refusal(motion.build, _context())
    assert re.match(rf"AdaptiveSampling\.{name} is {value}; use a (whole )?number", output)
