"""Terms that act, command, place and count, judged by numpy: what they write, and within which ranges they draw."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation

from tests.support.worker.terms_rig import (
    ACTIONS,
    BODIES,
    JOINTS,
    OBJECT,
    OBJECT_DOF,
    ROOT,
    ROOT_DOF,
    SECONDS,
    WORLDS,
    Rig,
    array,
    close,
    matrix,
    terms_of,
)
from worker.simulation.sensors.differential_ik import IkArrays
from worker.simulation.sensors.wrench import WrenchArrays

DRAWS = 120


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Rig:
    wrench, frame = WrenchArrays(), IkArrays()
    wrench.wrenches = array(np.zeros((WORLDS, BODIES, 6)), wp.spatial_vector)
    wrench.bodies, wrench.left = array([1, 4], wp.int32), array(np.zeros(WORLDS))
    frame.target = array(np.zeros((WORLDS, 3)))
    structs = {WrenchArrays: wrench, IkArrays: frame}
    tested = terms_of("actions", "commands", "episode", "events")
    return Rig([*tested, "root_linear_velocity"], tmp_path_factory.mktemp("commands"), structs)


@pytest.fixture
def rig(made: Rig) -> Iterator[Rig]:
    with made.kept():
        yield made


def draws(rig: Rig, read: Callable[[], np.ndarray], term: str, **numbers: object) -> np.ndarray:
    """What a term writes with many seeds, shape ``(seeds * worlds, ...)``."""
    found = []
    for seed in range(DRAWS):
        rig.call(term, stream=seed, **numbers)
        found.append(np.array(read()))
    return np.concatenate(found)


def evenly(values: np.ndarray, low: float, high: float) -> None:
    """Whether numbers are spread evenly between two: within them, near both ends, with the mean in the middle."""
    span = high - low
    assert values.min() >= low - 1e-5 and values.max() <= high + 1e-5
    assert values.min() < low + 0.05 * span and values.max() > high - 0.05 * span
    assert abs(values.mean() - (low + high) / 2) < 4 * span / np.sqrt(12 * len(values))


def memory(rig: Rig, first: int, count: int) -> np.ndarray:
    return rig.episodes.memory.numpy()[:, first : first + count].astype(float)


def heading(rig: Rig) -> np.ndarray:
    turn = matrix(rig.worlds.joint_q.numpy()[:, ROOT + 3 : ROOT + 7])
    return np.arctan2(turn[:, 1, 0], turn[:, 0, 0])


def test_actions_write_the_input_of_their_joints_actuator(rig: Rig) -> None:
    columns, coordinates = rig.robot.actuators.numpy(), rig.robot.coordinates.numpy()
    for joint in range(JOINTS - 1):
        bias, effort = rig.robot.encoder_bias.numpy()[:, joint], rig.robot.efforts.numpy()[joint]
        gain, rest = (numbers.numpy()[joint] for numbers in (rig.robot.gains, rig.robot.references))
        low, high = rig.robot.ranges.numpy()[joint]
        here = rig.q[:, coordinates[joint]]
        for name, numbers, requested in (
            ("effort", {"value": 1.7}, 1.7),
            ("limited_effort", {"value": 0.4}, 0.4 * effort / gain),
            ("limited_effort", {"value": -7.0}, -effort / gain),
            ("position_target", {"value": 0.3}, 0.3 - bias + rest),
            ("limited_position_target", {"value": 9.0, "soft_factor": 0.8}, high - 0.1 * (high - low) - bias + rest),
            ("relative_position_target", {"value": 0.2}, here + 0.2 + rest),
            ("share_of_range_target", {"value": -0.5}, low + 0.25 * (high - low) - bias + rest),
            ("share_of_range_target", {"value": 3.0}, high - bias + rest),
            ("two_positions_target", {"value": -0.1, "closed": 0.1, "opened": 0.9}, 0.1 - bias + rest),
            ("two_positions_target", {"value": 0.0, "closed": 0.1, "opened": 0.9}, 0.9 - bias + rest),
            ("velocity_target", {"value": -2.0}, -2.0),
            ("two_velocities_target", {"value": -1.0, "closing": -3.0, "opening": 3.0}, -3.0),
        ):
            rig.worlds.controls.zero_()
            rig.call(name, joint, **numbers)
            expected = np.zeros((WORLDS, ACTIONS))
            expected[:, columns[joint]] = requested
            np.testing.assert_allclose(rig.worlds.controls.numpy(), expected, rtol=1e-5, atol=1e-6, err_msg=name)


def test_a_smoothed_target_begins_where_the_joint_is(rig: Rig) -> None:
    rig.episodes.memory.zero_()
    joint, bias, rest = 2, rig.robot.encoder_bias.numpy()[:, 2], rig.robot.references.numpy()[2]
    target = rig.q[:, rig.robot.coordinates.numpy()[joint]] + bias
    for value in (1.0, -0.5):
        rig.call("smoothed_position_target", joint, value=value, memory=20, share=0.3)
        target = 0.3 * value + 0.7 * target
        column = rig.robot.actuators.numpy()[joint]
        np.testing.assert_allclose(rig.worlds.controls.numpy()[:, column], target - bias + rest, rtol=1e-5, atol=1e-6)


def test_terms_of_actions_are_their_formulas(rig: Rig) -> None:
    names = ("actions", "last_actions", "earlier_actions")
    now, last, earlier = (getattr(rig.episodes, name).numpy() for name in names)
    jerk = now - 2 * last + earlier
    for action in range(ACTIONS):
        for name, requested in {
            "last_action": last,
            "clipped_last_action": np.clip(last, -1, 1),
            "action_squared": now**2,
            "action_magnitude": np.abs(now),
            "action_excess": np.maximum(np.abs(now) - 1, 0),
            "action_rate_squared": (now - last) ** 2,
            "action_acceleration": jerk,
            "action_acceleration_squared": jerk**2,
            "mean_action_acceleration": np.abs(jerk) / ACTIONS,
        }.items():
            close(rig.call(name, action), requested[:, action], name, rtol=1e-5, atol=1e-6)


def test_velocity_commands_come_evenly_from_their_ranges_and_shares(rig: Rig) -> None:
    ranges = {"forward": (-1.0, 2.0), "left": (-0.5, 0.5), "turn": (-1.5, 1.0)}
    found = draws(rig, lambda: memory(rig, 5, 3), "velocity_command", command=5, **ranges)
    for column, (low, high) in enumerate(ranges.values()):
        evenly(found[:, column], low, high)
    assert np.abs(np.corrcoef(found.T) - np.eye(3)).max() < 0.15
    shares = {"standing_share": 0.3, "turning_share": 0.5, "forward_share": 0.5}
    found = draws(rig, lambda: memory(rig, 5, 3), "velocity_command", command=5, **ranges, **shares)
    still = ~found.any(axis=1)
    spot = ~found[:, :2].any(axis=1) & ~still
    ahead = ~found[:, 1:].any(axis=1) & ~still
    for share, requested in ((still, 0.3), (spot, 0.35), (ahead, 0.175)):
        assert abs(share.mean() - requested) < 4 * np.sqrt(requested * (1 - requested) / len(share))
    assert found[ahead, 0].min() >= 0.3 - 1e-6
    half = draws(rig, lambda: memory(rig, 5, 3), "velocity_command", command=5, grows=True, **ranges)
    full = draws(rig, lambda: memory(rig, 5, 3), "velocity_command", command=5, **ranges)
    np.testing.assert_allclose(half, 0.5 * full, rtol=1e-6)  # the level is 0.5


def test_an_episode_may_begin_at_its_commanded_velocity(rig: Rig) -> None:
    ranges = {"forward": (1.0, 2.0), "left": (-0.5, 0.5), "turn": (0.5, 1.0)}
    before = rig.worlds.joint_qd.numpy().copy()
    rig.call("moving_velocity_command", command=5, stream=1, moving_share=1.0, **ranges)
    after = rig.worlds.joint_qd.numpy()
    np.testing.assert_array_equal(after[1:], before[1:])  # ages of 7 and 100: their episodes began before
    found = rig.call("root_linear_velocity")[0]
    np.testing.assert_allclose(found, [*memory(rig, 5, 2)[0], 0.0], atol=1e-5)
    rig.worlds.joint_qd.assign(before)
    rig.call("moving_velocity_command", command=5, stream=1, moving_share=0.0, **ranges)
    np.testing.assert_array_equal(rig.worlds.joint_qd.numpy(), before)


def test_a_heading_command_turns_the_robot_and_a_world_command_keeps_its_direction(rig: Rig) -> None:
    ranges = {"forward": (-1.0, 2.0), "left": (-0.5, 0.5), "turn": (-0.4, 0.6), "heading": (-3.0, 3.0)}
    yaw = heading(rig)
    for shares in ({"heading_share": 1.0}, {"heading_share": 0.0}, {"world_share": 1.0}, {"standing_share": 1.0}):
        rig.call("heading_velocity_command", command=5, stream=4, **ranges, **shares)
        drawn, hidden = memory(rig, 5, 3), memory(rig, 8, 6)
        rig.call("steer_velocity_command", command=5, turn=(-0.4, 0.6), stiffness=0.5)
        steered = memory(rig, 5, 3)
        if shares.get("standing_share"):
            assert not steered.any() and not drawn.any()
            continue
        turned = np.clip(0.5 * np.angle(np.exp(1j * (hidden[:, 0] - yaw))), -0.4, 0.6)
        requested = drawn[:, 2] if shares.get("heading_share") == 0.0 else turned
        np.testing.assert_allclose(steered[:, 2], requested, atol=1e-5)
        seen = (drawn[:, 0] + 1j * drawn[:, 1]) * (np.exp(-1j * yaw) if shares.get("world_share") else 1.0)
        np.testing.assert_allclose(steered[:, 0] + 1j * steered[:, 1], seen, atol=1e-5)
    term = "heading_velocity_command"
    found = draws(rig, lambda: memory(rig, 5, 9), term, command=5, heading_share=0.25, **ranges)
    evenly(found[:, 3], -3.0, 3.0)
    assert abs(found[:, 4].mean() - 0.25) < 0.06
    straight = draws(rig, lambda: memory(rig, 5, 3), term, command=5, forward_share=1.0, **ranges)
    assert straight[:, 0].min() >= 0.3 - 1e-6 and not straight[:, 1:].any()


def test_commands_of_numbers_and_places(rig: Rig) -> None:
    box = {"x": (0.1, 0.4), "y": (-0.3, 0.2), "z": (0.5, 0.9)}
    evenly(draws(rig, lambda: memory(rig, 3, 1), "number_command", command=3, bounds=(0.2, 0.8)), 0.2, 0.8)
    found = draws(rig, lambda: memory(rig, 3, 3), "position_command", command=3, **box)
    for column, (low, high) in enumerate(box.values()):
        evenly(found[:, column], low, high)
    angles = {"roll": (0.0, 0.0), "pitch": (0.0, 0.0), "yaw": (-1.0, 2.0)}
    found = draws(rig, lambda: memory(rig, 3, 7), "pose_command", command=3, **box, **angles)
    evenly(2 * np.arctan2(found[:, 5], found[:, 6]), -1.0, 2.0)
    assert not found[:, 3:5].any()

    places = {f"object_{axis}": bounds for axis, bounds in box.items()} | {"object_yaw": (-1.0, 1.0)}
    rig.call("lift_command", command=3, stream=9, robot=rig.other, **box, **places)
    pose = rig.worlds.joint_q.numpy()[:, OBJECT : OBJECT + 7]
    velocity = rig.worlds.joint_qd.numpy()[:, OBJECT_DOF : OBJECT_DOF + 6]
    assert not velocity.any() and np.abs(2 * np.arctan2(pose[:, 5], pose[:, 6])).max() <= 1.0
    for axis, (low, high) in enumerate(box.values()):
        assert (pose[:, axis] >= low).all() and (pose[:, axis] <= high).all()
        assert (memory(rig, 3, 3)[:, axis] >= low).all() and (memory(rig, 3, 3)[:, axis] <= high).all()
    assert np.abs(memory(rig, 3, 3) - pose[:, :3]).min() > 1e-4

    rig.call("planar_pose_command", command=3, stream=2, x=(-1.0, 1.0), y=(1.0, 2.0), heading=(0.0, 3.0))
    seen, target = memory(rig, 3, 3), memory(rig, 6, 3)
    here = rig.worlds.joint_q.numpy()[:, ROOT : ROOT + 2]
    way = ((target[:, 0] - here[:, 0]) + 1j * (target[:, 1] - here[:, 1])) * np.exp(-1j * heading(rig))
    np.testing.assert_allclose(seen[:, 0] + 1j * seen[:, 1], way, atol=1e-5)
    np.testing.assert_allclose(seen[:, 2], np.angle(np.exp(1j * (target[:, 2] - heading(rig)))), atol=1e-5)
    start = np.array(rig.robot.start)[:2]
    assert (np.abs(target[:, 0] - start[0]) <= 1).all() and (target[:, 1] - start[1] >= 1).all()


def test_a_policy_sees_its_command(rig: Rig) -> None:
    numbers = rig.episodes.memory.numpy()
    np.testing.assert_allclose(rig.call("command_number", 2, command=4), numbers[:, 6])
    np.testing.assert_allclose(rig.call("command_vector", command=4), numbers[:, 4:7])
    np.testing.assert_allclose(rig.call("command_rotation", command=4), numbers[:, 7:11])
    speed = np.hypot(numbers[:, 4], numbers[:, 5]) + np.abs(numbers[:, 6])
    np.testing.assert_allclose(rig.call("command_speed", command=4), speed, rtol=1e-6)


def test_a_root_is_placed_around_its_start(rig: Rig) -> None:
    start = np.array(rig.robot.start)
    ranges = {
        "x": (-1.0, 2.0),
        "z": (0.1, 0.2),
        "yaw": (-3.0, 3.0),
        "velocity_y": (-0.5, 1.0),
        "turning_x": (-2.0, 1.0),
    }

    def read() -> np.ndarray:
        state = rig.worlds.joint_q.numpy()[:, ROOT : ROOT + 7], rig.call("root_linear_velocity")
        return np.concatenate([*state, rig.worlds.joint_qd.numpy()[:, ROOT_DOF + 3 : ROOT_DOF + 6]], axis=1)

    untouched = rig.worlds.joint_q.numpy()[:, :ROOT].copy()
    found = draws(rig, read, "reset_root", **ranges)
    evenly(found[:, 0] - start[0], -1.0, 2.0)
    np.testing.assert_allclose(found[:, 1], start[1], atol=1e-6)
    evenly(found[:, 2] - start[2], 0.1, 0.2)
    turns = Rotation.from_quat(found[:, 3:7])
    turned = (Rotation.from_quat(start[3:]).inv() * turns).as_rotvec()
    np.testing.assert_allclose(turned[:, :2], 0.0, atol=1e-5)
    evenly(turned[:, 2], -3.0, 3.0)
    evenly(turns.apply(found[:, 7:10])[:, 1], -0.5, 1.0)
    evenly(found[:, 10], -2.0, 1.0)
    assert not found[:, 11:].any()
    np.testing.assert_array_equal(rig.worlds.joint_q.numpy()[:, :ROOT], untouched)

    found = draws(rig, read, "reset_root_any_way_up", z=(1.0, 1.0))
    np.testing.assert_allclose(np.linalg.norm(found[:, 3:7], axis=1), 1.0, atol=1e-5)
    np.testing.assert_allclose((found[:, 3:7, None] * found[:, None, 3:7]).mean(0), np.eye(4) / 4, atol=0.05)
    assert np.abs(found[:, 7:]).max() < 1e-6


def test_joints_are_placed_within_their_ranges(rig: Rig) -> None:
    for joint in (0, JOINTS - 1):
        coordinate, dof = rig.robot.coordinates.numpy()[joint], rig.robot.dofs.numpy()[joint]
        default, (low, high) = rig.robot.defaults.numpy()[joint], rig.robot.ranges.numpy()[joint]
        middle, half = (0.5 * low + 0.5 * high, 0.45 * (high - low)) if joint == 0 else (0.0, 0.0)

        def read(columns: tuple[int, int] = (coordinate, dof)) -> np.ndarray:
            q, qd = rig.worlds.joint_q.numpy(), rig.worlds.joint_qd.numpy()
            return np.stack([q[:, columns[0]], qd[:, columns[1]]], axis=1)

        numbers = {"position": (-9.0, 9.0), "velocity": (-1.0, 3.0), "element": joint}
        found = draws(rig, read, "reset_joints_by_offset", soft_factor=0.9, **numbers)
        evenly(found[:, 1], -1.0, 3.0)
        if joint == 0:
            close(np.array([found[:, 0].min(), found[:, 0].max()]), [middle - half, middle + half], atol=1e-5)
            found = draws(rig, read, "reset_joints_between_limits", soft_factor=0.9, element=joint)
            evenly(found[:, 0], middle - half, middle + half)
        else:
            evenly(found[:, 0] - default, -9.0, 9.0)
            found = draws(rig, read, "reset_joints_between_limits", element=joint)
            np.testing.assert_allclose(found[:, 0], default)
        found = draws(rig, read, "reset_joints_in_range", **numbers)
        evenly(found[:, 0], -9.0, 9.0)
        found = draws(rig, read, "reset_joints_by_scale", position=(0.5, 1.5), element=joint)
        scaled = np.sort([0.5 * default, 1.5 * default])
        assert (found[:, 0] >= max(scaled[0], low) - 1e-5).all() and (found[:, 0] <= min(scaled[1], high) + 1e-5).all()
        assert not found[:, 1].any()


def test_a_reset_to_the_default_and_a_push(rig: Rig) -> None:
    rig.call("reset_to_default")
    q, qd = rig.worlds.joint_q.numpy(), rig.worlds.joint_qd.numpy()
    np.testing.assert_allclose(q[:, ROOT : ROOT + 7], np.tile(np.array(rig.robot.start), (WORLDS, 1)), atol=1e-6)
    np.testing.assert_allclose(q[:, rig.robot.coordinates.numpy()], np.tile(rig.robot.defaults.numpy(), (WORLDS, 1)))
    assert not qd[:, ROOT_DOF : ROOT_DOF + 6 + JOINTS].any()
    np.testing.assert_array_equal(qd[:, OBJECT_DOF:], rig.qd[:, OBJECT_DOF:])

    rig.worlds.joint_qd.assign(rig.qd)
    before = rig.call("root_linear_velocity")
    rig.call("push", stream=5, velocity_x=(0.5, 0.5), turning_z=(1.0, 1.0))
    after = rig.call("root_linear_velocity")
    turns = Rotation.from_quat(rig.worlds.joint_q.numpy()[:, ROOT + 3 : ROOT + 7])
    np.testing.assert_allclose(turns.apply(after - before), np.tile([0.5, 0, 0], (WORLDS, 1)), atol=1e-5)
    turning = rig.worlds.joint_qd.numpy()[:, ROOT_DOF + 3 : ROOT_DOF + 6] - rig.qd[:, ROOT_DOF + 3 : ROOT_DOF + 6]
    np.testing.assert_allclose(turning, np.tile([0, 0, 1.0], (WORLDS, 1)), atol=1e-6)


def test_terms_of_the_episode(rig: Rig) -> None:
    ages = np.array([0, 7, 100])
    np.testing.assert_allclose(rig.call("elapsed"), ages * SECONDS, rtol=1e-6)
    np.testing.assert_allclose(rig.call("time_left", limit=3.0), 3.0 - ages * SECONDS, rtol=1e-6)
    phase = 2 * np.pi * ages * SECONDS / 0.7
    close(rig.call("gait_clock", period=0.7), np.stack([np.sin(phase), np.cos(phase)], 1), atol=1e-4)
    assert (rig.call("level") == 0.5).all()
    assert rig.call("older_than", limit=0.16).tolist() == [0, 1, 1]  # 8 steps of 0.02 s with the one that ends
    assert rig.call("older_than", limit=0.18).tolist() == [0, 0, 1]
    for terminated in (True, False):
        assert (rig.call("alive", terminated=terminated) == (not terminated)).all()
        assert (rig.call("ended", terminated=terminated) == terminated).all()
    assert not rig.call("not_finite").any()
    broken = rig.qd.copy()
    broken[1, 3] = np.nan
    rig.worlds.joint_qd.assign(broken)
    assert rig.call("not_finite").tolist() == [0, 1, 0]


def test_wrenches_are_drawn_from_their_ranges_and_a_frame_is_moved(rig: Rig) -> None:
    wrench, frame = rig.structs[WrenchArrays], rig.structs[IkArrays]
    rig.call("apply_wrench", stream=3, force=(1.0, 2.0), torque=(-2.0, -1.0))
    drawn = wrench.wrenches.numpy()
    assert (wrench.left.numpy() == -2.0).all() and not drawn[:, [0, 2, 3, 5, 6]].any()
    assert (drawn[:, [1, 4], :3] >= 1.0).all() and (drawn[:, [1, 4], :3] <= 2.0).all()
    assert (drawn[:, [1, 4], 3:] <= -1.0).all() and len(np.unique(drawn[:, [1, 4]])) == 12 * WORLDS
    rig.call("apply_impulse", stream=4, duration=(0.2, 0.4), force=(3.0, 3.0))
    left = wrench.left.numpy()
    assert (left >= 0.2).all() and (left <= 0.4).all() and (wrench.wrenches.numpy()[:, 1, :3] == 3.0).all()
    rig.call("move_frame", 1, value=0.5)
    assert frame.target.numpy().tolist() == [[0.0, 0.5, 0.0]] * WORLDS
