"""Go1 and G1 on the CPU: rewards and observations by numpy from MuJoCo's own engine, which steps beside them; rough ground by its rays."""

from __future__ import annotations

import dataclasses
import importlib.util
import math
from typing import Any

import mujoco
import numpy as np
import pytest
import torch

from tests.support.refusals import refusal
from tests.support.worker.tasks import play, put, same
from tests.support.worker.terms_rig import matrix
from tests.support.worker.walkers import Twin, plain
from worker.settings.overrides import Refused
from worker.settings.velocity import Go1FlatConfig, range_at, widest
from worker.simulation.terrain import Terrain
from worker.tasks import find_task
from worker.tasks.library.velocity import Velocity

WORLDS = 6
FEET = {
    "Go1Flat": [[f"{leg}_foot_collision"] for leg in ("FR", "FL", "RR", "RL")],
    "G1Flat": [[f"{side}_foot{number}_collision" for number in range(1, 8)] for side in ("left", "right")],
}
JOINT = {
    "Go1Flat": {"calf": (0.1, 0.6, 0.6), "": (0.05, 0.3, 0.3)},
    "G1Flat": {
        "hip_pitch": (0.05, 0.3, 0.5),
        "hip_roll": (0.05, 0.15, 0.2),
        "hip_yaw": (0.05, 0.15, 0.2),
        "knee": (0.05, 0.35, 0.6),
        "ankle_pitch": (0.05, 0.25, 0.35),
        "ankle_roll": (0.05, 0.1, 0.15),
        "waist_yaw": (0.05, 0.2, 0.3),
        "waist_roll": (0.05, 0.08, 0.08),
        "waist_pitch": (0.05, 0.1, 0.2),
        "shoulder_pitch": (0.05, 0.15, 0.5),
        "shoulder_roll": (0.05, 0.15, 0.2),
        "shoulder_yaw": (0.05, 0.1, 0.15),
        "elbow": (0.05, 0.15, 0.35),
        "wrist": (0.05, 0.3, 0.3),
    },
}
"""Tolerance of each joint while standing, walking and running [rad], as mjlab has them."""


@pytest.fixture(scope="module")
def tasks() -> dict[str, Velocity]:
    """The robots on a plane, made when they are first asked for."""

    class Made(dict):
        def __missing__(self, name: str) -> Velocity:
            self[name] = plain(name, WORLDS)
            return self[name]

    return Made()


def expected_rewards(name: str, twin: Twin, command: np.ndarray, action: np.ndarray, before: np.ndarray) -> Any:
    """Each reward per second, from MuJoCo's state and contacts."""
    data, view, walker = twin.data, twin.view, twin.task.walker
    requested = float(np.linalg.norm(command[:2]) + abs(command[2]))
    linear, angular = twin.velocity(mujoco.mjtObj.mjOBJ_XBODY, walker.base, True)
    tilt = twin.turn(walker.torso)[2, :2]
    tipping = twin.velocity(mujoco.mjtObj.mjOBJ_XBODY, walker.torso, False)[1][:2]
    position = data.qpos[twin.places]
    speed = 0 if requested < 0.05 else 1 if requested < 1.5 else 2
    allowed = np.array([next(v for k, v in JOINT[name].items() if k in joint)[speed] for joint in view.joint_names])
    ends = twin.model.jnt_range[[twin.model.joint(joint).id for joint in view.joint_names]]
    middle, half = ends.mean(1), 0.45 * (ends[:, 1] - ends[:, 0])
    heights, speeds = twin.soles()
    moves = float(requested > 0.05)
    twin.peak = np.where(twin.found == 0, np.maximum(twin.peak, heights), twin.peak)
    landed = twin.landed()
    swing = float(((twin.peak / 0.1 - 1.0) ** 2)[landed].sum())
    twin.peak = np.where(landed, 0.0, twin.peak)
    rewards = {
        "track_linear_velocity": np.exp(-np.sum((linear - [command[0], command[1], 0.0]) ** 2) / 0.25),
        "track_angular_velocity": np.exp(-np.sum((angular - [0.0, 0.0, command[2]]) ** 2) / 0.5),
        "upright": np.exp(-np.sum(tilt**2) / 0.2),
        "pose": np.exp(-np.mean((position - view.defaults) ** 2 / allowed**2)),
        "body_ang_vel": np.sum(tipping**2),
        "angular_momentum": np.sum(data.sensor("root_angmom").data ** 2),
        "dof_pos_limits": np.maximum(np.abs(position - middle) - half, 0.0).sum(),
        "action_rate_l2": np.sum((action - before) ** 2),
        "air_time": float(((twin.air > 0.05) & (twin.air < 0.5)).sum()) * (requested > 0.5),
        "foot_clearance": moves * np.sum(np.abs(heights - 0.1) * speeds),
        "foot_swing_height": moves * swing,
        "foot_slip": moves * np.sum(speeds[twin.found > 0] ** 2),
        "soft_landing": moves * np.linalg.norm(twin.forces, axis=1)[landed].sum(),
    }
    return rewards | ({"self_collisions": float(twin.hits)} if name.startswith("G1") else {})


def expected_groups(twin: Twin, command: np.ndarray, action: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What the policy and the critic see, without noise."""
    data = twin.data
    imu = [data.sensor(name).data for name in ("imu_lin_vel", "imu_ang_vel")]
    joints = [data.qpos[twin.places] - twin.view.defaults, data.qvel[twin.rates]]
    seen = np.concatenate([*imu, -twin.turn(twin.task.walker.base)[2], *joints, action, command])
    forces = twin.forces.ravel()
    heights, _ = twin.soles()
    known = [heights, twin.air, (twin.found > 0).astype(float), np.sign(forces) * np.log1p(np.abs(forces))]
    return seen, np.concatenate([seen, *known])


@pytest.mark.parametrize("name", ["Go1Flat", "G1Flat"])
def test_rewards_and_observations_are_those_of_mujocos_own_engine(tasks: dict[str, Velocity], name: str) -> None:
    task = tasks[name]
    task.seed(3)
    task.reset()
    twins = [Twin(task, FEET[name]) for _ in range(WORLDS)]
    state = task.state_dict()
    heights = {"Go1Flat": 0.26, "G1Flat": 0.76}[name]
    random = np.random.default_rng(2)
    first = state["joint_q"].numpy()
    first[:, 2] = heights + np.linspace(0.0, 0.02, WORLDS)  # some begin on the ground, some fall on it
    state["joint_qd"][:] = torch.tensor(random.normal(scale=0.3, size=state["joint_qd"].shape), dtype=torch.float32)
    memory = task.plan.binder.commands["twist"]
    requested = [[0, 0, 0], [0.3, 0, 0], [0.6, -0.4, 0.2], [1.0, 1.0, 0.5], [-1.0, 0.0, 0.0], [0.0, 0.0, 0.4]]
    state["memory"][:, memory : memory + 3] = torch.tensor(requested)
    state["memory"][:, memory + 3 : memory + 9] = 0.0
    state["memory"][:, memory + 9] = 100.0  # they hold
    task.load_state_dict(state)
    before = np.zeros((WORLDS, task.action_size))
    seen_terms: dict[str, float] = {}
    for _ in range(14):
        state = task.state_dict()
        q, qd, sums = (state[key].numpy() for key in ("joint_q", "joint_qd", "episode_sums"))
        action = random.normal(scale=0.4, size=before.shape).astype(np.float32)
        task.step(torch.tensor(action))
        controls = task.worlds.arrays.controls.numpy()
        after = task.state_dict()["episode_sums"].numpy()
        for world, twin in enumerate(twins):
            scale = [next(v for k, v in scales(name).items() if k in joint) for joint in twin.view.joint_names]
            targets = np.array(twin.view.defaults) + np.array(scale) * action[world]
            np.testing.assert_allclose(controls[world, twin.view.actuators], targets, atol=1e-5)
            twin.take(q[world], qd[world])
            twin.step(targets)
            if task.dones[world]:
                pytest.fail("nobody falls in this time")
            command = np.array(requested[world], float)
            rewards = expected_rewards(name, twin, command, action[world], before[world])
            assert list(rewards) == list(task.reward_terms)
            got = (after[world] - sums[world])[2 : 2 + len(rewards)] / 0.02
            for term, (value, expected) in zip(rewards, zip(got, rewards.values(), strict=True), strict=True):
                # a sum in float32 loses what it gained in a step, in proportion to itself
                slack = 1e-4 * max(1.0, abs(float(after[world][2 + list(rewards).index(term)])))
                assert float(value) == pytest.approx(float(expected), rel=0.01, abs=2e-3 + slack), (term, world)
                seen_terms[term] = max(seen_terms.get(term, 0.0), abs(float(expected)))
            policy, critic = expected_groups(twin, command, action[world])
            np.testing.assert_allclose(task.observations[world], policy, atol=2e-3, rtol=2e-3)
            np.testing.assert_allclose(task.groups["critic"][world], critic, atol=0.03, rtol=0.02)
        before = action
    quiet = {"self_collisions"} if name == "G1Flat" else set()
    assert {term for term, value in seen_terms.items() if value == 0.0} <= quiet | {"dof_pos_limits", "air_time"}


def scales(name: str) -> dict[str, float]:
    """How far an action of 1 moves a joint's target: a quarter of effort over stiffness, by what its name contains [rad]."""

    def of(rotor: float, effort: float) -> float:
        return 0.25 * effort / (rotor * (20.0 * 3.1415926535) ** 2)

    if name.startswith("Go1"):
        return {"calf": of(0.000111842 * 81, 35.55), "": of(0.000111842 * 36, 23.7)}
    small = 0.139e-4 * ((1 + 46 / 18) * (1 + 56 / 16)) ** 2 + 0.017e-4 * (1 + 56 / 16) ** 2 + 0.169e-4
    middle = 0.489e-4 * (4.5 * (1 + 48 / 22)) ** 2 + 0.098e-4 * (1 + 48 / 22) ** 2 + 0.533e-4
    large = 0.489e-4 * (4.5 * 5) ** 2 + 0.109e-4 * 25 + 0.738e-4
    wrist = of(0.068e-4 * 625, 5.0)
    names = {"hip_roll": of(large, 139.0), "knee": of(large, 139.0), "hip": of(middle, 88.0)}
    names |= {"waist_yaw": of(middle, 88.0), "waist": of(small, 25.0), "ankle": of(small, 25.0)}
    return names | {"wrist_pitch": wrist, "wrist_yaw": wrist, "": of(small, 25.0)}


@pytest.mark.parametrize("name", ["Go1Flat", "G1Flat"])
def test_every_joint_is_driven_about_its_home_position(tasks: dict[str, Velocity], name: str) -> None:
    task, view = tasks[name], tasks[name].views["robot"]
    assert task.action_names == tuple(view.joint_names) and len(view.joint_names) == {"Go1Flat": 12, "G1Flat": 29}[name]
    home = dict(zip(view.joint_names, view.defaults, strict=True))
    expected = {
        "Go1Flat": {"FR_hip_joint": 0.1, "RL_hip_joint": -0.1, "FL_thigh_joint": 0.9, "RR_calf_joint": -1.8},
        "G1Flat": {"left_hip_pitch_joint": -0.312, "right_knee_joint": 0.669, "left_shoulder_roll_joint": 0.2},
    }[name]
    assert {joint: home[joint] for joint in expected} == pytest.approx(expected)


def test_commands_grow_with_the_iterations(tasks: dict[str, Velocity]) -> None:
    task = tasks["Go1Flat"]
    for iteration, forward, turn in ((0, (-1, 1), (-0.5, 0.5)), (4999, (-1, 1), (-0.5, 0.5)), (5000, (-1.5, 2), (-0.7, 0.7)), (12000, (-2, 3), (-0.7, 0.7)), (0, (-1, 1), (-0.5, 0.5))):  # fmt: skip
        task.begin_iteration(iteration, None, None)
        assert task.numbers("commands.twist.forward").tolist() == list(forward)
        assert task.numbers("commands.twist.left").tolist() == [-1.0, 1.0]
        for place in ("commands.twist.turn", "commands.twist.update.turn"):
            assert task.numbers(place).tolist() == pytest.approx(list(turn))


@pytest.mark.parametrize(
    ("place", "field"),
    [("commands.twist.forward", "command_forward"), ("commands.twist.update.turn", "command_turn")],
)
def test_a_number_that_the_stages_of_a_command_set_is_refused(place: str, field: str) -> None:
    task = find_task("Go1Flat")
    with pytest.raises(ValueError, match=rf"the stages of {field} set {place} before every iteration; use {field}$"):
        task.sketch(task.config_type(numbers={place: [2.0, 3.0]}))
    other = "commands.twist.least_forward"
    assert task.sketch(task.config_type(numbers={other: 0.25})).plan.numbers.places[other][1] == 1


def test_the_end_of_the_ground_is_that_of_the_terrain_that_the_task_has() -> None:
    rough = find_task("Go1Rough")

    class Wide(rough):
        def terrain(self, config: Any) -> Terrain:
            return dataclasses.replace(super().terrain(config), border=7.0)

    plan = Wide.sketch(rough.config_type()).plan
    first, _ = plan.numbers.find("terminations.out_of_terrain_bounds.margin", "the test")
    assert plan.numbers.values[first] == pytest.approx(7.0 - 0.3)


def test_stages_of_commands() -> None:
    stages = ((0, -1.0, 1.0), (10, -2.0, 0.5))
    assert [range_at(stages, iteration) for iteration in (0, 9, 10, 99)] == [(-1, 1), (-1, 1), (-2, 0.5), (-2, 0.5)]
    assert widest(stages) == (-2.0, 1.0)
    made: Any = Go1FlatConfig.configured({"command_forward": [[0, -1, 1], [50, -1.0, 1.5]]})
    assert range_at(made.command_forward, 60) == (-1.0, 1.5)
    for wrong, words in (
        ([[0, 1.0, -1.0]], "the least value comes before the greatest"),
        ([[5, -1.0, 1.0]], "the first is 0"),
        ([[0, -1, 1], [0, -1, 1]], "must grow"),
        ([[0, -1]], r"expected stages \[iteration, least, greatest\]"),
    ):
        with pytest.raises(Refused, match=words):
            Go1FlatConfig.configured({"command_forward": wrong})


def test_a_fall_is_a_tilt_of_seventy_degrees(tasks: dict[str, Velocity]) -> None:
    task = tasks["Go1Flat"]
    rows = []
    for world in range(WORLDS):
        angle = math.radians((68.0, 72.0)[world % 2]) / 2
        pose = [0.0, 0.0, 2.0, math.sin(angle), 0.0, 0.0, math.cos(angle)]
        rows.append([*pose, *task.views["robot"].defaults])
    put(task, joint_q=rows)
    task.step(torch.zeros(WORLDS, 12))
    assert task.dones.tolist() == [False, True] * 3 and not task.time_outs.any()


def test_a_resumed_run_goes_on_bit_for_bit() -> None:
    kind: Any = find_task("Go1Flat")
    whole = kind(kind.config_type(episode_seconds=0.3), 4, seed=5)
    play(whole, 10, 1)
    state = whole.state_dict()
    resumed = kind(kind.config_type(episode_seconds=0.3), 4, seed=5)
    resumed.load_state_dict(state)
    assert same(play(whole, 20, 2), play(resumed, 20, 2))


def test_without_the_package_there_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    found = importlib.util.find_spec
    without = {"mjlab": lambda *_: None}
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *rest: without.get(name, found)(name, *rest))
    kind: Any = find_task("G1Flat")
    output = refusal(kind, kind.config_type(), 1)
    assert "the Python package mjlab, which is not installed; " in output
    assert " pip install --no-deps mjlab==1.6.0" in output


@pytest.fixture(scope="module")
def rough() -> Velocity:
    return plain("Go1Rough", 4)


def test_it_sees_what_rays_of_mujoco_meet_and_stands_upright_on_it(rough: Velocity) -> None:
    rough.seed(4)
    rough.reset()
    state = rough.state_dict()
    state["terrain_levels"][:] = 6
    state["terrain_kinds"][:] = torch.tensor([1, 3, 5, 6])
    rough.load_state_dict(state)
    rough.reset()
    model = rough.worlds.solver.mj_model
    data = mujoco.MjData(model)
    data.qpos[2] = 100.0  # out of the way
    mujoco.mj_forward(model, data)
    columns = [number for number, name in enumerate(rough.observation_names) if name.startswith("height_scan")]
    assert len(columns) == 17 * 11 and len(rough.observation_names) == 235
    upright = 2 + rough.reward_terms.index("upright")
    bumpy = 0
    for step in range(3):
        before = rough.state_dict()["episode_sums"].numpy()
        rough.step(0.3 * torch.randn(4, 12, generator=torch.Generator().manual_seed(step)))
        state = rough.state_dict()
        for world in range(4):
            assert not rough.dones[world]
            root = state["joint_q"].numpy()[world].astype(float)
            place, turn = root[:3], matrix(root[3:7])
            yaw = np.arctan2(turn[1, 0], turn[0, 0])
            points = []
            for y in np.linspace(-0.5, 0.5, 11):
                for x in np.linspace(-0.8, 0.8, 17):
                    way = np.array((np.cos(yaw) * x - np.sin(yaw) * y, np.sin(yaw) * x + np.cos(yaw) * y))
                    at = place[:2] + way
                    start, geom = np.array([*at, 20.0]), np.zeros(1, np.int32)
                    down = mujoco.mj_ray(model, data, start, np.array([0.0, 0.0, -1.0]), None, 1, -1, geom)
                    points.append([*at, 20.0 - down])
            ground = np.array(points)
            seen = rough.observations[world].numpy()[columns]
            np.testing.assert_allclose(seen, (place[2] - ground[:, 2]) / 5.0, atol=2e-3)
            some = ground[np.arange(32) * 186 // 31]
            values, vectors = np.linalg.eigh(np.cov(some.T))
            normal = vectors[:, 0] * np.sign(vectors[2, 0])
            if values[0] >= 0.1 * values[1]:
                normal = np.array([0.0, 0.0, 1.0])
            bumpy += values[0] > 1e-5
            expected = np.exp(-np.sum((turn.T @ normal)[:2] ** 2) / 0.2)
            got = (state["episode_sums"].numpy() - before)[world, upright] / 0.02
            assert got == pytest.approx(expected, abs=5e-3)
    assert bumpy, "some of the ground is not flat"


def test_levels_follow_the_way_and_the_end_of_the_terrain_is_not_a_fall(rough: Velocity) -> None:
    rough.seed(4)
    rough.reset()
    state = rough.state_dict()
    terrain = rough.ground_terrain
    assert terrain is not None
    state["terrain_levels"][:] = torch.tensor([3, 3, 3, 0])
    kinds = state["terrain_kinds"].numpy()
    # far from the origin, near it, beyond the patches' border, near it on the first level
    ways = [(4.2, 0.0), (0.5, 0.0), (0.0, 0.0), (0.0, 0.5)]
    for world, way in enumerate(ways):
        origin = terrain.origins[int(state["terrain_levels"][world]), kinds[world]]
        state["joint_q"][world, :2] = torch.tensor(origin[:2] + way)
        state["joint_q"][world, 2] = float(origin[2]) + 1.0
    state["joint_q"][2, 0] = -terrain.corner[0] + terrain.border - 0.2
    column = rough.plan.binder.commands["twist"]
    state["memory"][:, column : column + 3] = torch.tensor([1.0, 0.0, 0.0])
    state["memory"][:, column + 3 : column + 9] = 0.0
    state["memory"][:, column + 9] = 100.0
    state["episode_length"][:] = torch.tensor([rough.max_episode_length - 1] * 2 + [5, rough.max_episode_length - 1])
    rough.load_state_dict(state)
    rough.step(torch.zeros(4, 12))
    assert rough.dones.all() and rough.time_outs.all()
    after = rough.state_dict()
    levels = after["terrain_levels"].tolist()
    assert levels[:2] == [4, 2] and levels[3] == 0
    for world, level in enumerate(levels):
        way = after["joint_q"].numpy()[world, :3] - terrain.origins[level, kinds[world]]
        assert (np.abs(way[:2]) <= 0.5 + 1e-5).all() and 0.287 <= way[2] <= 0.329
