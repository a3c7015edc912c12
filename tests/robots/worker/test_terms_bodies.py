"""Terms of roots and bodies: MuJoCo says what a moving body with an off-centre mass does, numpy the rest."""

from __future__ import annotations

import mujoco
import newton
import numpy as np
import pytest
import warp as wp
from newton.solvers import SolverMuJoCo
from scipy.spatial.transform import Rotation

from tests.support.worker.terms_rig import BODIES, ROOT, WORLDS, Rig, array, close, matrix, terms_of
from worker.simulation.robot_arrays import RobotArrays
from worker.simulation.robot_elements import empty_builder


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Rig:
    return Rig(terms_of("root", "bodies"), tmp_path_factory.mktemp("bodies"))


def alike(row: wp.array) -> wp.array:
    """The same row in every world."""
    return array(np.tile(row.numpy(), (WORLDS, 1)))


def velocities(model: mujoco.MjModel, data: mujoco.MjData) -> tuple[np.ndarray, np.ndarray]:
    """Angular and linear velocity of the first body in the world frame: of its origin, of its centre of mass."""
    origin, of_com = np.zeros(6), np.zeros(6)
    mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_XBODY, 1, origin, 0)
    mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_BODY, 1, of_com, 0)
    return origin, of_com


def test_a_body_with_an_off_centre_mass_moves_as_mujoco_says(rig: Rig) -> None:
    xml = """<mujoco><worldbody><body name="b" pos="0 0 1"><freejoint/>
        <inertial pos="0.2 -0.3 0.1" mass="2" diaginertia="0.2 0.25 0.3"/><geom size="0.1"/></body></worldbody></mujoco>"""
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    rotation = rig.random.normal(size=4)
    rotation /= np.linalg.norm(rotation)
    data.qpos[:] = [0.3, -0.5, 0.9, *rotation[[3, 0, 1, 2]]]
    data.qvel[:] = [0.4, -0.7, 0.2, 1.1, -0.6, 0.8]  # of the frame's origin; angular, in the body's own frame
    mujoco.mj_forward(model, data)
    world, of_com = velocities(model, data)

    # the same body in Newton, whose free joint has the velocity of the centre of mass
    builder = empty_builder()
    builder.add_mjcf(xml, ctrl_direct=True)
    scene = empty_builder()
    scene.replicate(builder, 1)
    found = scene.finalize(device="cpu")
    solver = SolverMuJoCo(found, separate_worlds=True, use_mujoco_cpu=True)  # steps with MuJoCo itself
    state, control = found.state(), found.control()
    state.joint_q.assign(np.array([0.3, -0.5, 0.9, *rotation], dtype=np.float32))
    state.joint_qd.assign(np.array([*of_com[3:], *world[:3]], dtype=np.float32))
    for _ in range(20):
        mujoco.mj_step(model, data)
        solver.step(state, state, control, None, model.opt.timestep)
    mujoco.mj_forward(model, data)
    world, of_com = velocities(model, data)
    own = np.concatenate([data.xmat[1].reshape(3, 3).T @ each for each in (world[:3], world[3:])])
    newton.eval_fk(found, state.joint_q, state.joint_qd, state)

    robot = RobotArrays()
    robot.root_coordinate, robot.root_dof, robot.root_body = 0, 0, 0
    with rig.kept():
        rig.worlds.joint_q, rig.worlds.joint_qd = alike(state.joint_q), alike(state.joint_qd)
        rig.bodies.poses = array(np.tile(state.body_q.numpy(), (WORLDS, 1, 1)), wp.transform)
        rig.bodies.velocities = array(np.tile(state.body_qd.numpy(), (WORLDS, 1, 1)), wp.spatial_vector)
        rig.bodies.coms = array(np.tile(found.body_com.numpy(), (WORLDS, 1, 1)), wp.vec3)
        for term, requested in (
            ("root_position", data.xpos[1]),
            ("root_linear_velocity", own[3:]),
            ("root_angular_velocity", own[:3]),
            ("root_linear_velocity_in_world", world[3:]),
            ("root_angular_velocity_in_world", world[:3]),
            ("root_com_linear_velocity_in_world", of_com[3:]),
            ("root_com_linear_velocity", data.xmat[1].reshape(3, 3).T @ of_com[3:]),
            ("projected_gravity", data.xmat[1].reshape(3, 3).T @ [0, 0, -1]),
            ("body_position", data.xpos[1]),
            ("body_com_position", data.xipos[1]),
            ("body_linear_velocity", world[3:]),
            ("body_linear_velocity_in_own_frame", own[3:]),
            ("body_com_linear_velocity", of_com[3:]),
            ("body_angular_velocity", world[:3]),
            ("body_angular_velocity_in_own_frame", own[:3]),
        ):
            close(rig.call(term, robot=robot), np.tile(requested, (WORLDS, 1)), term, atol=1e-4)
    assert np.linalg.norm(world[3:] - of_com[3:]) > 0.1  # else the two velocities would look alike


def test_every_other_term_of_the_root_is_its_formula(rig: Rig) -> None:
    position, rotation = rig.q[:, ROOT : ROOT + 3].astype(float), rig.q[:, ROOT + 3 : ROOT + 7]
    r = rig.root()
    matrices, yaw, origin, linear = r.turn, r.yaw, r.origin, r.linear
    start = np.array(rig.robot.start)[:3]
    tilt = 1 - matrices[:, 2, 2] ** 2
    target = np.array([0.7, -0.4])
    way = target - position[:, :2]

    close(rig.call("root_displacement"), position - start)
    close(rig.call("root_height"), position[:, 2])
    sign = np.where(rotation[:, 3:] < 0, -1, 1)
    assert (sign < 0).any() and (sign > 0).any()
    close(rig.call("root_orientation"), sign * rotation)
    for index in range(6):
        close(rig.call("root_orientation_element", index), matrices[:, :, :2].reshape(WORLDS, 6)[:, index])
    close(Rotation.from_euler("xyz", rig.call("root_angles")).as_matrix(), matrices)
    close(rig.call("heading"), yaw)
    close(rig.call("root_uprightness"), matrices[:, 2, 2])
    cosine, sine = np.cos(yaw), np.sin(yaw)
    ahead = cosine * origin[:, 0] + sine * origin[:, 1]
    aside = cosine * origin[:, 1] - sine * origin[:, 0]
    close(rig.call("root_velocity_in_heading_frame"), np.stack([ahead, aside, origin[:, 2]], axis=1))
    close(rig.call("angle_to_point", target=target), np.angle(np.exp(1j * (np.arctan2(way[:, 1], way[:, 0]) - yaw))))
    unit = way / np.linalg.norm(way, axis=1, keepdims=True)
    close(rig.call("facing_point", target=target), (matrices[:, :2, 0] * unit).sum(1))
    close(rig.call("velocity_towards", direction=(3.0, 4.0, 0.0)), linear @ [0.6, 0.8, 0.0])
    close(rig.call("vertical_velocity_squared"), r.own_origin[:, 2] ** 2)
    close(rig.call("vertical_com_velocity_squared"), np.einsum("wi,wi->w", matrices[:, :, 2], linear) ** 2)
    close(rig.call("tipping_rate_squared"), (r.own_angular[:, :2] ** 2).sum(1))
    close(rig.call("tilt_squared"), tilt)
    close(rig.call("upright", std=0.7), np.exp(-tilt / 0.49))
    close(rig.call("is_upright", threshold=0.1), matrices[:, 2, 2] > 0.1)
    close(rig.call("height_error_squared", target=0.4), (position[:, 2] - 0.4) ** 2)
    close(rig.call("height_shortfall", target=0.4), np.maximum(0.4 - position[:, 2], 0))
    middle = float(np.median(position[:, 2]))
    close(rig.call("root_too_low", height=middle), position[:, 2] < middle)
    close(rig.call("root_too_high", height=middle), position[:, 2] > middle)
    angle = np.arccos(matrices[:, 2, 2])
    between = float(np.sort(angle)[:2].mean())
    close(rig.call("root_tilted", limit=between), angle > between)
    distance = np.linalg.norm((position - start)[:, :2], axis=1)
    close(rig.call("root_too_far", distance=np.sort(distance)[:2].mean()), distance > np.sort(distance)[:2].mean())
    for name, values in (("linear", linear), ("angular", r.angular)):
        speed = np.linalg.norm(values, axis=1)
        limits = {"linear": 99.0, "angular": 99.0, name: np.sort(speed)[1:].mean()}
        close(rig.call("root_too_fast", **limits), speed > limits[name])


def test_a_fixed_root_is_where_it_starts_and_does_not_move(rig: Rig) -> None:
    fixed = RobotArrays()
    fixed.root_coordinate, fixed.root_dof, fixed.root_body = -1, -1, 2
    fixed.start = rig.robot.start
    close(rig.call("root_position", robot=fixed), np.tile(np.array(fixed.start)[:3], (WORLDS, 1)))
    down = matrix(np.array(fixed.start)[3:]).T @ [0, 0, -1]
    close(rig.call("projected_gravity", robot=fixed), np.tile(down, (WORLDS, 1)))
    for term in ("root_linear_velocity", "root_com_linear_velocity", "root_angular_velocity"):
        assert not rig.call(term, robot=fixed).any()


def test_every_term_of_a_body_is_its_formula(rig: Rig) -> None:
    base = rig.root().turn
    for body in range(BODIES):
        pose, velocity = rig.bodies.poses.numpy()[:, body], rig.bodies.velocities.numpy()[:, body]
        matrices = matrix(pose[:, 3:])
        arm = np.einsum("wij,wj->wi", matrices, rig.bodies.coms.numpy()[:, body])
        origin = velocity[:, :3] - np.cross(velocity[:, 3:], arm)
        inside = np.einsum("wji,wj->wi", base, pose[:, :3] - rig.q[:, ROOT : ROOT + 3])
        relative = np.einsum("wji,wjk->wik", base, matrices)
        gravity = -matrices[:, 2, :]
        cosine = np.clip((np.trace(relative, axis1=1, axis2=2) - 1) / 2, -1, 1)
        for name, requested in {
            "body_position": pose[:, :3],
            "body_height": pose[:, 2],
            "body_orientation": np.where(pose[:, 6:] < 0, -1, 1) * pose[:, 3:],
            "body_com_position": pose[:, :3] + arm,
            "body_position_in_root": inside,
            "body_forward_in_root": relative[:, :, 0],
            "body_left_in_root": relative[:, :, 1],
            "body_linear_velocity": origin,
            "body_linear_velocity_in_own_frame": np.einsum("wji,wj->wi", matrices, origin),
            "body_angular_velocity_in_own_frame": np.einsum("wji,wj->wi", matrices, velocity[:, 3:]),
            "body_com_linear_velocity": velocity[:, :3],
            "body_angular_velocity": velocity[:, 3:],
            "body_velocity_in_root": np.einsum("wji,wj->wi", base, origin),
            "body_projected_gravity": gravity,
            "body_tilt_squared": (gravity[:, :2] ** 2).sum(1),
            "body_tipping_rate_squared": (velocity[:, 3:5] ** 2).sum(1),
            "body_speed": np.linalg.norm(origin, axis=1),
            "body_speed_squared": (origin**2).sum(1),
        }.items():
            close(rig.call(name, body), requested, name)
        close(matrix(rig.call("body_orientation_in_root", body)), relative)
        assert (rig.call("body_orientation_in_root", body)[:, 3] >= 0).all()
        np.testing.assert_allclose(np.cos(rig.call("body_turn_from_root", body)), cosine, atol=1e-5)
        close(rig.call("body_upright", body, std=0.5), np.exp(-(gravity[:, :2] ** 2).sum(1) / 0.25))
        close(rig.call("body_height_error_squared", body, target=0.2), (pose[:, 2] - 0.2) ** 2)
        close(rig.call("body_too_low", body, height=0.1), pose[:, 2] < 0.1)
        close(rig.call("body_tilted", body, limit=1.2), np.arccos(matrices[:, 2, 2]) > 1.2)
    heights = rig.bodies.poses.numpy()[..., 2] < 0.1
    assert heights.any() and not heights.all()
