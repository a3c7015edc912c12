"""Real robots move as in MuJoCo's own engine."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
import pytest

from tests.support.worker.robots import build, need_mjlab, reference
from worker.simulation.robot import Robot
from worker.simulation.robot_view import RobotView
from worker.tasks import find_task

STEPS = 200


@pytest.fixture(params=["Go1Flat", "G1Flat"])
def robot(request: pytest.FixtureRequest) -> Robot:
    """Of that task."""
    return robot_of(request.param)


def robot_of(name: str) -> Robot:
    need_mjlab()
    task: Any = find_task(name)
    return task.walker.robot()


def test_a_robot_moves_as_in_mujocos_own_engine(robot: Robot):
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


def test_the_compiled_model_is_mujocos(robot: Robot):
    template, worlds = build(robot)
    view = RobotView(template)
    ours, theirs = worlds.solver.mj_model, reference(robot)
    dofs = [int(theirs.joint(name).dofadr[0]) for name in view.joint_names]
    for field in ("dof_armature", "dof_frictionloss", "dof_damping"):
        np.testing.assert_allclose(getattr(ours, field)[view.dofs], getattr(theirs, field)[dofs], rtol=1e-5)
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
        for field in ("contype", "conaffinity", "condim", "priority", "friction", "solref"):
            mine, wanted = getattr(ours, f"geom_{field}")[index], getattr(theirs, f"geom_{field}")[its]
            np.testing.assert_allclose(mine, wanted, rtol=1e-5, err_msg=f"{field} of {name}")
        compared += 1
    assert compared == sum(bool(theirs.geom(name).contype[0]) for name in view.geom_names)
