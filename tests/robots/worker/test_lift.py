"""The arm that lifts a cube, on the CPU, against MuJoCo's own engine and formulas by hand."""

from __future__ import annotations

import math
import re

import mujoco
import numpy as np
import pytest
import torch

from tests.support.refusals import refusal
from tests.support.worker.lift_reference import GAINS, HOME, TIPS, reference, stiffness, to_mujoco, touching_pairs
from tests.support.worker.robots import needs_mjlab
from tests.support.worker.tasks import observe, put, statistics
from worker.learning.job import configure
from worker.settings.errors import UserError
from worker.settings.lift import LiftCubeConfig
from worker.tasks import find_task
from worker.tasks.library.lift import LiftCube

pytestmark = needs_mjlab
WORLDS = 4
ABSENT = [0.3, 0.15, 0.02, 0.0, 0.0, 0.0, 1.0]
"""A cube that lies on the ground beside the gripper."""


@pytest.fixture(scope="module")
def lift() -> LiftCube:
    return LiftCube(LiftCubeConfig(), WORLDS, seed=1)


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return reference()


def geom_names(task: LiftCube) -> list[str]:
    """Short names of the solver's geoms as the file has them."""
    solver = task.worlds.solver.mj_model
    names = [solver.geom(geom).name.rpartition("/")[2] for geom in range(solver.ngeom)]
    return ["ground" if "ground" in name else re.sub(r"_\d+$", "", name) for name in names]


def slippery(model: mujoco.MjModel, task: LiftCube, world: int) -> mujoco.MjModel:
    """MuJoCo's model with the friction that one of the worlds drew."""
    drawn, names = task.worlds.solver.mjw_model.geom_friction.numpy()[world], geom_names(task)
    for geom in range(model.ngeom):
        model.geom_friction[geom] = drawn[names.index(model.geom(geom).name)] if model.geom(geom).name else 0.0
    return model


def site(model: mujoco.MjModel, qpos: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Position and rotation matrix of the site between the fingertips."""
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    index = model.site("grasp_site").id
    return data.site_xpos[index].copy(), data.site_xmat[index].reshape(3, 3).copy()


def test_it_is_found_and_its_names_are_those_of_the_file(lift: LiftCube) -> None:
    assert find_task("LiftCube") is LiftCube
    joints = [*(f"joint{number}" for number in range(1, 7)), "left_finger", "right_finger"]
    expected = [f"{joint}_{term}" for term in ("joint_pos", "joint_vel") for joint in joints]
    expected += [f"{term}_{axis}" for term in ("ee_to_cube", "cube_to_goal") for axis in "xyz"]
    expected += [f"{joint}_actions" for joint in joints[:7]]
    assert lift.observation_names == tuple(expected) and lift.observation_shape == (29,)
    assert lift.action_names == tuple(joints[:7])
    assert (lift.max_episode_length, lift.worlds.timestep) == (1000, pytest.approx(0.005))
    assert lift.reward_terms == ("lift", "lift_precise", "action_rate_l2", "joint_pos_limits", "joint_vel_hinge")


def test_the_solvers_model_is_mujocos_own(lift: LiftCube, model: mujoco.MjModel) -> None:
    solver = lift.worlds.solver.mj_model
    ours = {solver.body(body).name.rpartition("_worldbody_")[2]: body for body in range(solver.nbody)}
    for body in range(1, model.nbody - 1):
        chain, parent = model.body(body).name, model.body_parentid[body]
        while parent:
            chain, parent = f"{model.body(parent).name}_{chain}", model.body_parentid[parent]
        assert solver.body_mass[ours[chain]] == pytest.approx(model.body_mass[body], rel=1e-5), chain
        assert solver.body_ipos[ours[chain]] == pytest.approx(model.body_ipos[body], abs=1e-6), chain
    assert solver.body_mass[-1] == pytest.approx(0.05) and solver.body_inertia[-1] == pytest.approx(0.05 * 0.04**2 / 6)
    assert np.allclose(solver.jnt_range[:8], model.jnt_range[:8], atol=1e-6)
    assert np.allclose(solver.dof_armature, model.dof_armature, rtol=1e-6)
    assert np.allclose(solver.dof_invweight0, model.dof_invweight0, rtol=1e-3)
    for name in ("actuator_gainprm", "actuator_biasprm", "actuator_forcerange"):
        assert np.allclose(getattr(solver, name), getattr(model, name), rtol=1e-6), name
    assert np.allclose(solver.eq_data, model.eq_data) and solver.neq == 1
    options = lift.worlds.solver.mjw_model.opt
    assert (options.iterations, options.ls_iterations) == (10, 20)
    assert options.cone == model.opt.cone and options.integrator == model.opt.integrator
    assert options.impratio_invsqrt.numpy()[0] ** -2 == pytest.approx(10.0)


def test_what_touches_what_is_as_in_mujoco(lift: LiftCube, model: mujoco.MjModel) -> None:
    solver, names = lift.worlds.solver.mj_model, geom_names(lift)
    theirs = [model.geom(geom).name for geom in range(model.ngeom)]
    pairs = touching_pairs(model, theirs)
    assert touching_pairs(solver, names) == pairs and len(pairs) > 200
    assert frozenset(("lf_down6_collision", "rf_down6_collision")) in pairs
    assert frozenset(("link6_1_collision", "lf_rot1_collision")) not in pairs, "parent and child"
    for geom, name in enumerate(names):
        if not solver.geom_contype[geom]:
            continue
        other = theirs.index(name)
        if re.fullmatch(TIPS, name):
            assert model.geom_friction[other] == pytest.approx([1.0, 5e-3, 5e-4])
        for field in ("condim", "priority", "friction", "solref", "solimp", "margin", "gap", "solmix"):
            found, expected = (getattr(each, f"geom_{field}") for each in (solver, model))
            assert np.allclose(found[geom], expected[other], rtol=1e-5), (name, field)


def test_the_arm_moves_as_in_mujocos_engine(lift: LiftCube, model: mujoco.MjModel) -> None:
    """Random targets far from the ground for half a second; the cube drops from 5 cm onto a corner's side and comes to rest."""
    put(lift, joint_q=[[*HOME, 0.3, 0.2, 0.05, 0.0, 0.0, math.sin(0.3), math.cos(0.3)]] * WORLDS)
    data = mujoco.MjData(model)
    data.qpos[:] = to_mujoco(lift.worlds.arrays.joint_q.numpy()[0])
    scale = np.array([0.25 * GAINS[joint][3] / stiffness(joint) for joint in GAINS])
    generator = np.random.default_rng(3)
    for _ in range(25):
        action = generator.uniform(-1.0, 1.0, 7)
        lift.step(torch.tensor(action, dtype=torch.float32).expand(WORLDS, 7))
        data.ctrl[:] = HOME[:7] + scale * action
        for _ in range(4):
            mujoco.mj_step(model, data)
        ours = to_mujoco(lift.worlds.arrays.joint_q.numpy()[0])
        assert np.allclose(ours[:8], data.qpos[:8], atol=2e-4)
        assert np.allclose(lift.worlds.arrays.joint_qd.numpy()[0, :8], data.qvel[:8], atol=5e-3)
        assert np.allclose(ours[8:], data.qpos[8:], atol=1e-3)
    assert np.abs(data.qpos[:6] - HOME[:6]).max() > 0.1, "it moved"
    assert not lift.dones.any()


def test_observation_and_reward_by_hand(lift: LiftCube, model: mujoco.MjModel) -> None:
    joints = HOME + np.array([0.3, -0.95, 0.1, 0.2, -0.1, 0.4, 0.018, -0.018])
    velocities = np.array([0.4, -0.9, 0.0, 1.5, 0.0, 0.0, -0.6, 0.6])
    cube, target = np.array([0.31, -0.07, 0.12]), np.array([0.4, 0.1, 0.25])
    put(
        lift,
        joint_q=[[*joints, *cube, 0.0, 0.0, math.sin(0.2), math.cos(0.2)]] * WORLDS,
        joint_qd=[[*velocities, *[0.0] * 6]] * WORLDS,
        last_actions=[[0.5, 0.0, 0.0, 0.0, 0.0, 0.0, -1.0]] * WORLDS,
    )
    state = lift.state_dict()
    state["memory"][:, :3] = torch.tensor(target, dtype=torch.float32)
    lift.load_state_dict(state)
    lift.actions.zero_()
    lift.actions[:, 0] = 2.5
    observe(lift)
    hand, _ = site(model, to_mujoco(np.array([*joints, *cube, 0.0, 0.0, math.sin(0.2), math.cos(0.2)])))
    exact = lift.groups["critic"][0].numpy()
    expected = np.concatenate([joints - HOME, velocities, cube - hand, target - cube, [2.5, 0, 0, 0, 0, 0, 0]])
    assert np.allclose(exact, expected, atol=1e-5)

    reach, way = np.sum((cube - hand) ** 2), np.sum((target - cube) ** 2)
    middle = model.jnt_range[:8].mean(axis=1)
    half = 0.45 * (model.jnt_range[:8, 1] - model.jnt_range[:8, 0])
    terms = {
        "lift": math.exp(-reach / 0.04) * (1.0 + math.exp(-way / 0.09)),
        "lift_precise": math.exp(-way / 0.0025),
        "action_rate_l2": -0.01 * (2.0**2 + 1.0),
        "joint_pos_limits": -10.0 * np.maximum(np.abs(joints - middle) - half, 0.0).sum(),
        "joint_vel_hinge": -0.01 * (np.maximum(np.abs(velocities) - 0.5, 0.0) ** 2).sum(),
    }
    assert terms["joint_pos_limits"] < -0.5, "two joints and both fingers are near an end of their ranges"
    sums = dict(zip(lift.reward_terms, lift.state_dict()["episode_sums"][0, 2:].tolist(), strict=False))
    for name, value in terms.items():
        assert sums[name] == pytest.approx(value / 50, abs=1e-6), name
    assert lift.rewards[0].item() == pytest.approx(sum(terms.values()) / 50, abs=1e-6)


def test_the_policy_sees_noise_and_the_critic_does_not(lift: LiftCube) -> None:
    put(lift)
    widths = np.concatenate([[0.01] * 8, [1.5] * 8, [0.01] * 6, [0.0] * 7])
    found = []
    for _ in range(60):
        lift.step(torch.zeros(WORLDS, 7))
        found.append((lift.observations - lift.groups["critic"]).numpy().copy())
    noise = np.concatenate(found)
    assert (np.abs(noise) <= widths + 1e-6).all() and (noise[:, 22:] == 0).all()
    # 240 draws of a uniform number: a deviation of w / sqrt(3), and the ends are nearly reached
    assert np.allclose(noise[:, :22].std(axis=0), widths[:22] / math.sqrt(3.0), rtol=0.15)
    assert (np.abs(noise[:, :22]).max(axis=0) > 0.95 * widths[:22]).all()


def test_an_episode_begins_at_home(lift: LiftCube) -> None:
    put(lift)
    rows = lift.worlds.arrays.joint_q.numpy()
    assert np.allclose(rows[:, :8], HOME) and (lift.worlds.arrays.joint_qd.numpy() == 0).all()
    assert (rows[:, 10] >= 0.02).all() and (rows[:, 10] <= 0.05).all()
    assert len(np.unique(rows[:, 8])) == WORLDS


def test_a_gripper_that_presses_on_the_ground_ends_the_episode(lift: LiftCube) -> None:
    """Poses with the fingers above the ground, touching it, and deep in it; MuJoCo says how hard they press."""
    poses, forces = [], []
    for angle in (1.7, 1.8, 1.9, 2.0):  # of the shoulder: the greater, the lower the hand
        joints = HOME.copy()
        joints[1] = angle
        poses.append([*joints, *ABSENT])
    put(lift, joint_q=poses)
    for world, pose in enumerate(poses):
        model = slippery(reference(), lift, world)
        data = mujoco.MjData(model)
        data.qpos[:] = to_mujoco(np.array(pose))
        data.ctrl[:] = HOME[:7]
        strongest = 0.0
        for _ in range(4):
            mujoco.mj_step(model, data)
            strongest = max(strongest, _strongest_on_ground(model, data))
        forces.append(strongest)
    lift.step(torch.zeros(WORLDS, 7))
    pressed = np.array(forces) > 10.0
    assert pressed.tolist() == [False, False, True, True] and 1.0 < forces[1] < 9.0 and forces[2] > 11.0
    assert lift.dones.tolist() == pressed.tolist() and not lift.time_outs.any()
    assert statistics(lift)["termination_ee_ground_collision"] == pressed.sum()


def _strongest_on_ground(model: mujoco.MjModel, data: mujoco.MjData) -> float:
    """Norm of the strongest contact between ground and gripper [N]; the cube's do not count."""
    strongest, force = 0.0, np.zeros(6)
    for contact in range(data.ncon):
        names = {model.geom(geom).name for geom in data.contact[contact].geom}
        if "ground" in names and "cube" not in names:
            mujoco.mj_contactForce(model, data, contact, force)
            strongest = max(strongest, float(np.linalg.norm(force[:3])))
    return strongest


def test_fingers_that_close_on_the_cube_hold_it_as_in_mujoco(lift: LiftCube) -> None:
    model = slippery(reference(), lift, 0)
    joints = HOME.copy()
    joints[6:] = 0.0199, -0.0199  # the fingertips are a tenth of a millimetre into the cube's sides
    position, rotation = site(model, to_mujoco(np.array([*joints, *ABSENT])))
    position += 0.014 * rotation[:, 0]  # the middle between the tips
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, rotation.flatten())
    put(lift, joint_q=[[*joints, *position, *quaternion[1:], quaternion[0]]] * WORLDS)
    data = mujoco.MjData(model)
    data.qpos[:] = to_mujoco(lift.worlds.arrays.joint_q.numpy()[0])
    close = -0.6
    action = torch.zeros(WORLDS, 7)
    action[:, 6] = close
    data.ctrl[:] = HOME[:7]
    data.ctrl[6] += close * 0.25 * GAINS["left_finger"][3] / stiffness("left_finger")
    for _ in range(50):
        lift.step(action)
        for _ in range(4):
            mujoco.mj_step(model, data)
    assert not lift.dones.any()
    ours = to_mujoco(lift.worlds.arrays.joint_q.numpy()[0])
    assert ours[10] > 0.1 and data.qpos[10] > 0.1, "what is not held lies on the ground after 0.2 s"
    assert np.allclose(ours[:8], data.qpos[:8], atol=2e-3) and np.allclose(ours[8:11], data.qpos[8:11], atol=5e-3)
    assert ours[6] == pytest.approx(-ours[7], abs=1e-3), "the right finger follows the left one"
    between = {frozenset(model.geom(geom).name for geom in data.contact[contact].geom) for contact in range(data.ncon)}
    assert any("cube" in pair and any("lf_down" in name for name in pair) for pair in between)
    assert any("cube" in pair and any("rf_down" in name for name in pair) for pair in between)


def test_fingertips_differ_from_world_to_world(lift: LiftCube) -> None:
    tips = [geom for geom, name in enumerate(geom_names(lift)) if re.fullmatch(TIPS, name)]
    others = sorted(set(range(lift.worlds.solver.mj_model.ngeom)) - set(tips))
    friction, own = lift.worlds.solver.mjw_model.geom_friction.numpy(), lift.worlds.solver.mj_model.geom_friction
    assert friction.shape[0] == WORLDS and len(tips) == 12 and (friction[:, others] == own[others]).all()
    for axis, (least, greatest) in enumerate(((0.3, 1.5), (1e-4, 2e-2), (1e-5, 5e-3))):
        drawn = friction[:, tips, axis].flatten()
        assert (drawn >= least).all() and (drawn <= greatest).all() and len(np.unique(drawn)) == 12 * WORLDS
        if axis:  # uniform in the logarithm: half of them lie below the geometric mean
            drawn, least, greatest = np.log(drawn), math.log(least), math.log(greatest)
        assert 0.3 < np.mean(drawn < 0.5 * (least + greatest)) < 0.7 and np.ptp(drawn) > 0.7 * (greatest - least)


@pytest.mark.parametrize(
    ("config", "message"),
    [
        ({"cube_x": [0.4, 0.2]}, "train.config.cube_x: expected [least, greatest], found [0.4, 0.2]"),
        ({"ground_force": 0}, "train.config.ground_force: expected a value greater than 0, found 0"),
        ({"target_w": 1}, "train.config.target_w: LiftCubeConfig has no such key; did you mean target_z?"),
    ],
)
def test_impossible_settings_are_refused_in_one_line(config: dict, message: str) -> None:
    assert refusal(configure, LiftCube, {"config": config}, error=UserError) == message
