"""Muster's own robots observe, earn, fall and start as formulas in numpy say of the same random states."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
import torch
import warp as wp
from scipy.spatial.transform import Rotation

from tests.support.worker.tasks import observe, put
from worker.tasks import find_task
from worker.tasks.run.task import Task

WORLDS = 48


@dataclass
class Formulas:
    """What a task should say of each world, shapes ``(worlds, columns)`` and ``(worlds,)``.

    An observation is ``scale * (raw - offset)``; terms are those of the rewards, then the metrics.
    """

    raw: np.ndarray
    units: list[str]
    terms: dict[str, np.ndarray]
    fallen: np.ndarray
    scale: Any = 1.0
    offset: Any = 0.0


def cartpole(task: Any, q: np.ndarray, qd: np.ndarray, actions: np.ndarray, **_: Any) -> Formulas:
    fallen = (np.abs(q) > (task.config.cart_limit, task.config.angle_limit)).any(axis=1)
    squares = {"angle": q[:, 1], "position": q[:, 0], "velocity": qd[:, 0], "effort": np.clip(actions[:, 0], -1, 1)}
    terms = {"alive": ~fallen, **{name: value**2 for name, value in squares.items()}, "fall": fallen}
    return Formulas(np.hstack((q, qd)), ["m", "rad", "m/s", "rad/s"], terms, fallen)


def running(task: Any, q: np.ndarray, qd: np.ndarray, actions: np.ndarray, **_: Any) -> Formulas:
    config, model, joints = task.config, task.worlds.solver.mj_model, task.action_size
    rotation = Rotation.from_quat(q[:, 3:7])
    forward, left, up = np.moveaxis(rotation.as_matrix(), 2, 0)
    attitude = [np.arctan2(forward[:, 1], forward[:, 0]), np.arctan2(left[:, 2], up[:, 2]), up[:, 2], forward[:, 0]]
    velocities = [rotation.apply(part, inverse=True) for part in (qd[:, :3], qd[:, 3:6])]
    felt = np.clip(actions, -1, 1)
    raw = np.hstack((q[:, 2:3], *velocities, np.stack(attitude, 1), q[:, 7:], qd[:, 6:], felt))
    middle, half = model.jnt_range[1:].mean(axis=1), np.ptp(model.jnt_range[1:], axis=1) / 2
    scale = [1.0] * 4 + [config.angular_velocity_scale] * 3 + [1.0] * 4
    scale += [*(1 / half), *[config.velocity_scale] * joints, *[1.0] * joints]
    offset = np.hstack((np.zeros(11), middle, np.zeros(2 * joints)))

    motor_of = dict(zip(model.actuator_trnid[:, 0], model.actuator_gear[:, 0], strict=True))
    strength = np.array([motor_of[1 + joint] for joint in range(joints)]) / max(motor_of.values())
    depth = np.clip((np.abs((q[:, 7:] - middle) / half) - 0.98) / 0.02, 0, 1)
    fallen = q[:, 2] < config.fall_height
    terms = {
        "forward": qd[:, 0],
        "heading": np.minimum(forward[:, 0] / 0.8, 1),
        "up": up[:, 2] > 0.93,
        "alive": np.ones(WORLDS),
        "action": (actions**2).sum(axis=1),
        "energy": np.abs(felt * qd[:, 6:] * config.velocity_scale) @ strength,
        "limits": depth @ strength,
    }
    terms = {name: value * ~fallen for name, value in terms.items()} | {"fall": fallen}
    units = ["m", *["m/s"] * 3, *["rad/s"] * 3, "rad", "rad", "1", "1"]
    units += [unit for unit in ("rad", "rad/s", "1") for _ in range(joints)]
    return Formulas(raw, units, terms, fallen, scale, offset)


def quadruped(
    task: Any, q: np.ndarray, qd: np.ndarray, actions: np.ndarray, last: np.ndarray, drives: np.ndarray, memory: Any
) -> Formulas:
    config, command = task.config, memory[:, :3]
    stand = np.tile([config.stand_hip, config.stand_thigh, config.stand_knee], 4)
    rotation = Rotation.from_quat(q[:, 3:7])
    linear, angular = (rotation.apply(part, inverse=True) for part in (qd[:, :3], qd[:, 3:6]))
    gravity = rotation.apply([0, 0, -1], inverse=True)
    raw = np.hstack((linear, angular, gravity, command, q[:, 7:], qd[:, 6:], np.clip(actions, -1, 1)))
    scale = [*[1.0] * 24, *[config.velocity_scale] * 12, *[1.0] * 12]
    offset = np.hstack((np.zeros(12), stand, np.zeros(24)))

    wrong = linear[:, :2] - command[:, :2], angular[:, 2] - command[:, 2]
    low, high = task.worlds.solver.mj_model.jnt_range[1:].T
    margin = 0.05 * (high - low)
    excess = np.maximum(low + margin - q[:, 7:], 0) + np.maximum(q[:, 7:] - high + margin, 0)
    fallen = (q[:, 2] < np.abs(gravity) @ (0.19, 0.09, 0.055)) | (-gravity[:, 2] < np.cos(config.tilt_limit))
    rates = {
        "track_linear": np.exp(-4 * (wrong[0] ** 2).sum(axis=1)),
        "track_angular": np.exp(-4 * wrong[1] ** 2),
        "lin_vel_z": linear[:, 2] ** 2,
        "ang_vel_xy": (angular[:, :2] ** 2).sum(axis=1),
        "orientation": (gravity[:, :2] ** 2).sum(axis=1),
        "torques": (drives[:, 6:] ** 2).sum(axis=1),
        "action_rate": ((actions - last) ** 2).sum(axis=1),
        "pose": ((q[:, 7:] - stand) ** 2).sum(axis=1),
        "limits": excess.sum(axis=1),
    }
    terms = {name: value / config.control_hz for name, value in rates.items()} | {"fall": fallen}
    terms |= {"metric_error_vel_xy": np.hypot(*wrong[0].T), "metric_error_vel_yaw": np.abs(wrong[1])}
    units = [*["m/s"] * 3, *["rad/s"] * 3, *["1"] * 3, "m/s", "m/s", "rad/s"]
    units += [unit for unit in ("rad", "rad/s", "1") for _ in range(12)]
    return Formulas(raw, units, terms, fallen, scale, offset)


FORMULAS = {"Cartpole": cartpole, "Ant": running, "Humanoid": running, "Quadruped": quadruped}


@pytest.fixture(scope="module", params=FORMULAS)
def task(request: pytest.FixtureRequest) -> Task:
    kind = find_task(request.param)
    weights = {name: 0.5 + number for number, name in enumerate(kind.config_type().rewards)}  # none as it comes
    return kind(kind.config_type(rewards=weights), WORLDS, seed=3)


def test_observations_rewards_and_falls_are_those_of_the_formulas(task: Task) -> None:
    random, model = np.random.default_rng(4), task.worlds.solver.mj_model
    joints = task.worlds.arrays.joint_q.shape[1] - 7
    if joints > 0:
        low, high = model.jnt_range[1:].T
        turns = Rotation.from_rotvec(0.5 * random.normal(size=(WORLDS, 3))).as_quat()
        heights = task.config.start_height * random.uniform(0.2, 1.5, (WORLDS, 1))
        angles = low + (high - low) * np.clip(random.uniform(-0.1, 1.1, (WORLDS, joints)), -0.01, 1.01)
        q = np.hstack((random.normal(size=(WORLDS, 2)), heights, turns, angles))
    else:
        q = random.normal(size=(WORLDS, 2)) * (1.5, 0.25)
    qd = random.normal(size=(WORLDS, task.worlds.arrays.joint_qd.shape[1]))
    actions, last = 1.5 * random.normal(size=(2, WORLDS, task.action_size))
    rows: dict[str, Any] = {"joint_q": q, "joint_qd": qd}
    more: dict[str, Any] = {}
    if type(task).__name__ == "Quadruped":
        more = {"last": last, "drives": 5 * random.normal(size=qd.shape), "memory": random.normal(size=(WORLDS, 4))}
        more["memory"][:, 3] = 3.0  # steps until the next command
        rows |= {"last_actions": last, "memory": more["memory"]}
    put(task, **rows)
    task.actions.copy_(torch.from_numpy(actions))
    if more:
        wp.to_torch(task.worlds.arrays.drives).copy_(torch.from_numpy(more["drives"]))
    observe(task)

    formulas = FORMULAS[type(task).__name__](task, q, qd, actions, **more)
    ended = torch.from_numpy(formulas.fallen)
    assert 5 < ended.sum() < WORLDS - 5
    assert torch.equal(task.dones, ended) and not task.time_outs.any()
    seen = torch.where(ended[:, None], task.terminal_observations, task.observations)
    np.testing.assert_allclose(seen, formulas.scale * (formulas.raw - formulas.offset), atol=2e-5)
    names = [*task.reward_terms, *task.metric_names]
    assert names == list(formulas.terms)
    weights = np.array([*task.config.rewards.values(), *[1.0] * len(task.metric_names)])
    values = weights * np.stack([*formulas.terms.values()], 1)
    np.testing.assert_allclose(task.state_dict()["episode_sums"][~ended, 2:], values[~ended], rtol=1e-4, atol=2e-5)
    np.testing.assert_allclose(task.rewards, values[:, : len(task.reward_terms)].sum(axis=1), rtol=1e-4, atol=5e-5)
    assert (np.abs(values).max(axis=0) > 0).all(), "each term has something to say"
    interface = task.interface()
    assert interface is not None and [seen.unit for seen in interface.observations] == formulas.units
    columns = np.array([(seen.scale, seen.offset) for seen in interface.observations]).T
    expected = np.broadcast_arrays(formulas.scale, formulas.offset, formulas.raw[0])[:2]
    np.testing.assert_allclose(columns, expected, atol=1e-6)
    if task.observation_names[-1].endswith("previous_action"):
        assert not task.observations[ended, -task.action_size :].any(), "a new episode has no previous action"


def test_episodes_start_near_the_standing_pose_as_far_as_the_noise_reaches(task: Task) -> None:
    task.reset()
    q, qd = task.worlds.arrays.joint_q.numpy(), task.worlds.arrays.joint_qd.numpy()
    config: Any = task.config
    interface: Any = task.interface()
    if type(task).__name__ == "Cartpole":
        assert interface.actions[0].default_position == 0.0
        moved, angle, velocity = q, (config.start_position, config.start_angle), config.start_velocity
    else:
        np.testing.assert_allclose(q[:, :7], np.tile([0, 0, config.start_height, 0, 0, 0, 1], (WORLDS, 1)), atol=1e-6)
        low, high = task.worlds.solver.mj_model.jnt_range[1:].T
        moved = q[:, 7:] - [action.default_position for action in interface.actions]
        if type(task).__name__ != "Quadruped":
            assert (q[:, 7:] >= low - 1e-6).all() and (q[:, 7:] <= high + 1e-6).all() and not qd[:, :6].any()
            qd = qd[:, 6:]
        angle, velocity = config.start_angle_noise, config.start_velocity_noise
    for found, noise in ((moved, angle), (qd, velocity)):
        shares = found / np.asarray(noise)
        assert (np.abs(shares) <= 1 + 1e-5).all() and shares.min() < -0.9 and shares.max() > 0.9
        assert len(np.unique(shares[:, 0])) > 0.9 * WORLDS
