"""Real robots move as in MuJoCo's own engine."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from tests.support.worker.robots import G1, GO1, build, need_mjlab, reference
from worker.simulation.robot import Robot
from worker.simulation.robot_view import RobotView

STEPS = 200


@pytest.mark.parametrize("robot", [GO1, G1], ids=["go1", "g1"])
def test_a_robot_moves_as_in_mujocos_own_engine(robot: Robot):
    need_mjlab()
    template, worlds = build(robot)
    view = RobotView(template)
    model = reference(robot)
    data = mujoco.MjData(model)

    joints = [model.joint(name) for name in view.joint_names]
    places = [int(joint.qposadr[0]) for joint in joints]
    controls = [int(model.actuator(name).id) for name in view.joint_names]
    default = np.array(view.defaults)
    data.qpos[:3] = robot.position
    data.qpos[3:7] = (1.0, 0.0, 0.0, 0.0)
    data.qpos[places] = default
    worlds.restore_defaults()
    reached, wanted = [], []
    inputs = np.zeros(worlds.arrays.controls.shape, np.float32)
    for step in range(STEPS):
        # every joint moves about its default position, no two alike
        targets = default + 0.15 * np.sin(0.05 * step + np.arange(len(default)))
        data.ctrl[controls] = targets
        inputs[0, view.actuators] = targets
        worlds.arrays.controls.assign(inputs)
        mujoco.mj_step(model, data)
        worlds.simulate()
        reached.append(worlds.arrays.joint_q.numpy()[0, view.coordinates])
        wanted.append(data.qpos[places].copy())
    assert np.ptp(np.array(wanted), axis=0).min() > 0.05, "every joint moves"
    np.testing.assert_allclose(np.array(reached), np.array(wanted), atol=0.01)
    root = worlds.arrays.joint_q.numpy()[0, :3]
    np.testing.assert_allclose(root, data.qpos[:3], atol=0.01)


@pytest.mark.parametrize("robot", [GO1, G1], ids=["go1", "g1"])
def test_the_compiled_model_is_mujocos(robot: Robot):
    need_mjlab()
    template, worlds = build(robot)
    view = RobotView(template)
    ours, theirs = worlds.solver.mj_model, reference(robot)
    dofs = [int(theirs.joint(name).dofadr[0]) for name in view.joint_names]
    np.testing.assert_allclose(ours.dof_armature[view.dofs], theirs.dof_armature[dofs], rtol=1e-5)
    np.testing.assert_allclose(ours.dof_frictionloss[view.dofs], theirs.dof_frictionloss[dofs], rtol=1e-5)
    np.testing.assert_allclose(ours.dof_damping[view.dofs], theirs.dof_damping[dofs], rtol=1e-5)
    np.testing.assert_allclose(ours.body_subtreemass[0], theirs.body_subtreemass[0], rtol=1e-5)
    inputs = [int(theirs.actuator(name).id) for name in view.joint_names]
    for field in ("actuator_gainprm", "actuator_biasprm", "actuator_forcerange", "actuator_ctrllimited"):
        mine, its = getattr(ours, field)[view.actuators], getattr(theirs, field)[inputs]
        np.testing.assert_allclose(mine, its, rtol=1e-5, err_msg=field)
    geoms = {ours.geom(index).name.rpartition("/")[2].rpartition("_")[0]: index for index in range(ours.ngeom)}
    compared = 0
    for name, index in geoms.items():
        if name not in view.geom_names:
            continue
        its = theirs.geom(name).id
        for field in (
            "geom_contype",
            "geom_conaffinity",
            "geom_condim",
            "geom_priority",
            "geom_friction",
            "geom_solref",
        ):
            mine, wanted = getattr(ours, field)[index], getattr(theirs, field)[its]
            np.testing.assert_allclose(mine, wanted, rtol=1e-5, err_msg=f"{field} of {name}")
        compared += 1
    assert compared == sum(bool(theirs.geom(name).contype[0]) for name in view.geom_names)


@pytest.mark.parametrize("height", [0.32, 0.26], ids=["above", "on the ground"])
def test_only_touching_geoms_are_contacts(height: float):
    need_mjlab()
    template, worlds = build(GO1)
    view = RobotView(template)
    model = reference(GO1)
    data = mujoco.MjData(model)
    data.qpos[:7] = (0.0, 0.0, height, 1.0, 0.0, 0.0, 0.0)
    data.qpos[[int(model.joint(name).qposadr[0]) for name in view.joint_names]] = view.defaults
    mujoco.mj_step(model, data)
    worlds.restore_defaults()
    row = worlds.arrays.joint_q.numpy()
    row[0, 2] = height
    worlds.arrays.joint_q.assign(row)
    worlds.simulate()
    assert int(worlds.solver.mjw_data.nacon.numpy()[0]) == data.ncon
    assert (data.ncon > 0) == (height == 0.26)
