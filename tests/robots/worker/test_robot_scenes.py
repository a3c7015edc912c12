"""Robots of other formats, several with objects in one world, who touches whom; real robots move as in MuJoCo itself."""

from __future__ import annotations

import math
from typing import Any

import mujoco
import numpy as np
import pytest

from tests.support.worker.lift_reference import touching_pairs
from tests.support.worker.robots import build, need_mjlab, reference
from worker.simulation.actuators import EffortActuator, PositionActuator
from worker.simulation.collisions import Collision
from worker.simulation.objects import Box, Capsule, Sphere
from worker.simulation.robot import Robot
from worker.simulation.robot_view import RobotView, body_arrays
from worker.tasks import find_task

SERVO = PositionActuator("*", 60.0, 3.0, armature=0.01)
# An arm on a mount that is a geom of the world, its two hinges between one pair of bodies: Newton makes them one joint.
ARM = """<mujoco model="arm"><option integrator="implicitfast"/><worldbody>
  <geom name="floor" type="plane" size="5 5 5"/><geom name="mount" type="box" size=".1 .1 .1" pos="0 0 .1"/>
  <body name="upper-arm" pos="0 0 .5"><joint name="yaw" type="hinge" axis="0 0 1" range="-90 90"/><joint name="pitch" axis="0 1 0"/>
    <geom name="upper" type="capsule" size=".04" fromto="0 0 0 .4 0 0"/><site name="tip" pos=".4 0 0"/>
    <body name="hand" pos=".5 0 0"><joint name="reach" type="slide" axis="1 0 0" range="-.1 .1"/>
      <geom name="palm" type="sphere" size=".05"/></body></body>
</worldbody></mujoco>"""


@pytest.mark.parametrize(
    ("file", "targets"),
    [
        ("newton:quadruped.urdf", np.tile([0.2, 0.4, -0.5], 4)),
        ("newton:ant.usda", np.tile([0.1, 0.9], 4) * [1, 1, 1, -1, 1, -1, 1, 1]),
    ],
    ids=["URDF", "USD"],
)
def test_a_robot_of_another_format_reaches_its_targets(file: str, targets: np.ndarray):
    robot = Robot(file, fixed=True, actuators=(PositionActuator("*", 400.0, 20.0, armature=0.05),), visuals=False)
    template, worlds = build(robot, ground=False, timestep=0.002, substeps=10, disable_contacts=True)
    view = RobotView(template)
    worlds.restore_defaults()
    controls = np.zeros(worlds.arrays.controls.shape, np.float32)
    controls[:, view.actuators] = targets
    worlds.arrays.controls.assign(controls)
    for _ in range(40):
        worlds.simulate()
    np.testing.assert_allclose(worlds.arrays.joint_q.numpy()[0, view.coordinates], targets, atol=0.02)


def test_a_usd_cart_is_driven_by_name_and_its_poles_are_not():
    template, worlds = build(Robot("newton:cartpole.usda", actuators=(EffortActuator("railCartJoint"),)), ground=False)
    view = RobotView(template)
    assert view.joint_names == ["railCartJoint", "cartPoleJoint", "polePoleJoint"]
    assert view.actuators == [0, -1, -1]
    assert worlds.arrays.controls.shape == (1, 1)


def test_floating_and_fixed_bases_and_their_start():
    for fixed, coordinate in ((False, 0), (True, -1)):
        placed = {"fixed": fixed, "position": (1.0, 2.0, 3.0), "rotation": (0.0, 0.0, 1.0, 1.0)}
        template, worlds = build(Robot("newton:quadruped.urdf", actuators=(SERVO,), **placed))
        view = RobotView(template)
        assert (view.root_coordinate, view.root_dof, view.root_body) == (coordinate, coordinate, 0)
        half = math.sqrt(0.5)
        np.testing.assert_allclose([*view.start], [1.0, 2.0, 3.0, 0.0, 0.0, half, half], rtol=1e-6)
        worlds.restore_defaults()
        worlds.update_bodies()
        np.testing.assert_allclose(body_arrays(worlds).poses.numpy()[0, 0], [1, 2, 3, 0, 0, half, half], atol=1e-6)


def test_a_fixed_robot_takes_its_mount_along_and_leaves_its_floor_behind():
    template, worlds = build(Robot(ARM, position=(1.0, 0.0, 0.7), actuators=(SERVO,)))
    view = RobotView(template)
    assert sorted(view.geom_names) == ["mount", "palm", "upper"]
    model = worlds.solver.mj_model
    mount = next(index for index in range(model.ngeom) if "mount" in model.geom(index).name)
    np.testing.assert_allclose(model.geom_pos[mount], [1.0, 0.0, 0.3], atol=1e-6)


def test_joints_between_one_pair_of_bodies_keep_their_names():
    robot = Robot(ARM, actuators=(SERVO,), joint_positions={"pitch": 0.3, "*": 0.05})
    template, worlds = build(robot, worlds=2)
    view = RobotView(template)
    assert view.joint_names == ["yaw", "pitch", "reach"]
    assert view.body_names == ["upper_arm", "hand"]
    assert view.site_names == ["tip"] and view.site_bodies == [0]
    np.testing.assert_allclose(view.site_poses[0].p, [0.4, 0.0, 0.0], rtol=1e-6)
    assert view.ranges[1] == (-math.inf, math.inf)
    np.testing.assert_allclose([view.ranges[0], view.ranges[2]], [[-math.pi / 2, math.pi / 2], [-0.1, 0.1]], rtol=1e-6)
    arrays = view.arrays(worlds)
    worlds.restore_defaults()
    q = worlds.arrays.joint_q.numpy()
    np.testing.assert_allclose(q[:, arrays.coordinates.numpy()], [[0.05, 0.3, 0.05]] * 2, rtol=1e-6)
    np.testing.assert_allclose(arrays.defaults.numpy(), [0.05, 0.3, 0.05], rtol=1e-6)
    assert arrays.encoder_bias.shape == (2, 3)

    # the hand's pose against the arm's geometry by hand: 0.05 rad about z, then 0.3 rad about the arm's own y
    worlds.update_bodies()
    hand = body_arrays(worlds).poses.numpy()[1, view.bodies[view.find_bodies("hand")[0]]]
    along = 0.5 + 0.05
    ahead = math.cos(0.3) * along
    expected = [math.cos(0.05) * ahead, math.sin(0.05) * ahead, 0.5 - math.sin(0.3) * along]
    np.testing.assert_allclose(hand[:3], expected, atol=1e-5)


def test_several_robots_and_objects_have_columns_of_their_own():
    items = (
        Robot(ARM, name="left", actuators=(SERVO,), joint_positions={"yaw": 0.1}),
        Box("cube", size=(0.1, 0.2, 0.3), mass=2.0, position=(1.0, 0.0, 0.5)),
        Robot(ARM, name="right", position=(0.0, 2.0, 0.5), actuators=(SERVO,), joint_positions={"yaw": 0.2}),
    )
    template, worlds = build(*items, worlds=2)
    views = [RobotView(template, name) for name in ("left", "cube", "right")]
    assert [view.joint_names for view in views] == [["yaw", "pitch", "reach"], [], ["yaw", "pitch", "reach"]]
    assert [view.actuators for view in views] == [[0, 1, 2], [], [3, 4, 5]]
    assert (views[1].root_coordinate, views[1].root_dof, views[1].root_body) == (3, 3, 2)
    worlds.restore_defaults()
    q = worlds.arrays.joint_q.numpy()
    assert q[0, views[0].coordinates[0]] == pytest.approx(0.1)
    assert q[1, views[2].coordinates[0]] == pytest.approx(0.2)
    np.testing.assert_allclose(q[1, 3:10], [1.0, 0.0, 0.5, 0.0, 0.0, 0.0, 1.0])

    # a torque on one arm's yaw moves that one alone
    controls = np.zeros((2, 6), np.float32)
    controls[0, views[2].actuators[0]] = 0.7
    worlds.arrays.controls.assign(controls)
    worlds.simulate()
    drives = worlds.arrays.drives.numpy()[0]
    # stiffness times distance, less the damping of the step: the order of forces is that of the coordinates
    assert drives[views[2].dofs[0]] == pytest.approx(60.0 * 0.5, rel=0.3)
    assert drives[views[0].dofs[0]] == pytest.approx(-60.0 * 0.1, rel=0.3)


@pytest.mark.parametrize(
    ("item", "kind", "size"),
    [
        (Box("thing", mass=2.0, size=(0.2, 0.4, 0.6)), mujoco.mjtGeom.mjGEOM_BOX, (0.1, 0.2, 0.3)),
        (Sphere("thing", mass=2.0, radius=0.3), mujoco.mjtGeom.mjGEOM_SPHERE, (0.3, 0.0, 0.0)),
        (Capsule("thing", mass=2.0, radius=0.1, length=0.5), mujoco.mjtGeom.mjGEOM_CAPSULE, (0.1, 0.25, 0.0)),
    ],
    ids=["box", "sphere", "capsule"],
)
def test_an_object_weighs_what_mujoco_says_and_comes_to_rest(item, kind, size):
    spec = mujoco.MjSpec()
    spec.worldbody.add_body().add_geom(type=kind, size=size, mass=2.0)
    expected = spec.compile()
    arm = Robot(ARM, position=(5.0, 0.0, 0.5), actuators=(SERVO,))
    lying = type(item)(**{**vars(item), "position": (0.0, 0.0, 0.36), "friction": 0.7})
    template, worlds = build(arm, lying, timestep=0.005, substeps=20)
    view = RobotView(template, "thing")
    model = worlds.solver.mj_model
    body = 1 + view.root_body
    np.testing.assert_allclose(model.body_mass[body], 2.0, rtol=1e-5)
    np.testing.assert_allclose(sorted(model.body_inertia[body]), sorted(expected.body_inertia[1]), rtol=1e-4)
    geom = int(model.body_geomadr[body])
    assert model.geom_friction[geom, 0] == pytest.approx(0.7)
    worlds.restore_defaults()
    for _ in range(6):
        worlds.simulate()
    root = view.root_coordinate
    q, qd = worlds.arrays.joint_q.numpy()[0], worlds.arrays.joint_qd.numpy()[0]
    standing = {"Box": 0.3, "Sphere": 0.3, "Capsule": 0.35}[type(item).__name__]
    assert q[root + 2] == pytest.approx(standing, abs=0.01)
    assert np.abs(qd[view.root_dof : view.root_dof + 6]).max() < 0.05


def test_a_fixed_object_stays():
    arm = Robot(ARM, position=(5.0, 0.0, 0.5), actuators=(SERVO,))
    template, worlds = build(arm, Box("wall", fixed=True, position=(0.0, 0.0, 2.0)), substeps=20)
    view = RobotView(template, "wall")
    worlds.restore_defaults()
    worlds.simulate()
    worlds.update_bodies()
    assert (view.root_coordinate, view.joint_names) == (-1, [])
    np.testing.assert_allclose(body_arrays(worlds).poses.numpy()[0, view.root_body, :3], [0.0, 0.0, 2.0], atol=1e-6)


def pairs_that_touch(*items) -> set[frozenset[str]]:
    """Names of the geoms of different bodies that MuJoCo's rule lets touch in the compiled model."""
    model = build(*items)[1].solver.mj_model
    names = [model.geom(index).name.rpartition("_")[0].replace("/worldbody", "") for index in range(model.ngeom)]
    return touching_pairs(model, [name.rpartition("/")[2] for name in names])


FINGERS = """<mujoco model="fingers"><worldbody><body name="palm" pos="0 0 1"><freejoint/><geom name="palm" size=".1"/>
  <body name="a" pos=".2 0 0"><joint name="a"/><geom name="a" size=".05"/></body>
  <body name="b" pos="0 .2 0"><joint name="b"/><geom name="b" size=".05"/></body>
</body></worldbody></mujoco>"""


def some(*pairs: str) -> set[frozenset[str]]:
    return {frozenset(pair.split("-")) for pair in pairs}


def test_collision_pairs_of_robots_and_objects():
    def fingers(**options) -> Robot:
        return Robot(FINGERS, actuators=(SERVO,), **options)

    ground = some("ground_plane-palm", "ground_plane-a", "ground_plane-b")
    cube = some("cube-palm", "cube-a", "cube-b", "cube-ground_plane")
    # a body and its parent never touch
    assert pairs_that_touch(fingers()) == ground | some("a-b")
    assert pairs_that_touch(fingers(self_collisions=False)) == ground
    assert pairs_that_touch(fingers(self_collisions=False), Sphere("cube")) == ground | cube
    tips = Collision(("a", "b"), contype=0, conaffinity=1)
    assert pairs_that_touch(fingers(collisions=(tips,))) == some("ground_plane-a", "ground_plane-b")
    # the base of a fixed robot never touches the ground, and its masks count as those of a free one
    fixed = fingers(fixed=True, collisions=(Collision(("a", "b"), contype=0, conaffinity=1, only=False),))
    assert pairs_that_touch(fixed) == some("ground_plane-a", "ground_plane-b")
    rest = Collision("a", contype=0, conaffinity=0, only=False)
    assert pairs_that_touch(fingers(collisions=(rest,))) == some("ground_plane-palm", "ground_plane-b")


def test_robots_without_self_collisions_still_touch_each_other():
    hands = [Robot(FINGERS, name=name, actuators=(SERVO,), self_collisions=False) for name in ("left", "right")]
    _, worlds = build(*hands)
    model = worlds.solver.mj_model
    of_left = [index for index in range(model.ngeom) if model.geom(index).name.startswith("left/")]
    of_right = [index for index in range(model.ngeom) if model.geom(index).name.startswith("right/")]

    def meet(first: int, second: int) -> bool:
        return bool(model.geom_contype[first] & model.geom_conaffinity[second])

    assert len(of_left) == len(of_right) == 3
    assert all(meet(a, b) and meet(b, a) for a in of_left for b in of_right)
    assert not any(meet(a, b) for mine in (of_left, of_right) for a in mine for b in mine)


def test_masks_of_a_file_give_way_to_those_declared():
    """The importer turns a file's masks into pairs of geoms that never touch: they don't outlive those masks."""
    apart = FINGERS.replace('name="a" size', 'name="a" contype="2" conaffinity="2" size')
    assert frozenset("ab") not in pairs_that_touch(Robot(apart, actuators=(SERVO,)))
    assert frozenset("ab") in pairs_that_touch(Robot(apart, actuators=(SERVO,), collisions=(Collision("*"),)))


@pytest.fixture(params=["Go1Flat", "G1Flat"])
def robot(request: pytest.FixtureRequest) -> Robot:
    """Of that task."""
    need_mjlab()
    task: Any = find_task(request.param)
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
    reached, requested = [], []
    inputs = np.zeros(worlds.arrays.controls.shape, np.float32)
    for step in range(200):
        # every joint moves about its default position, no two alike
        targets = default + 0.15 * np.sin(0.05 * step + np.arange(len(default)))
        data.ctrl[controls] = targets
        inputs[0, view.actuators] = targets
        worlds.arrays.controls.assign(inputs)
        mujoco.mj_step(model, data)
        worlds.simulate()
        reached.append(worlds.arrays.joint_q.numpy()[0, view.coordinates])
        requested.append(data.qpos[places].copy())
    assert np.ptp(np.array(requested), axis=0).min() > 0.05, "every joint moves"
    np.testing.assert_allclose(np.array(reached), np.array(requested), atol=0.01)
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
            mine, requested = getattr(ours, f"geom_{field}")[index], getattr(theirs, f"geom_{field}")[its]
            np.testing.assert_allclose(mine, requested, rtol=1e-5, err_msg=f"{field} of {name}")
        compared += 1
    assert compared == sum(bool(theirs.geom(name).contype[0]) for name in view.geom_names)
