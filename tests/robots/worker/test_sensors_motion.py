"""Frames, inertial measurements and momenta against the sensors of MuJoCo's own engine."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tests.support.refusals import refusal
from tests.support.worker.sensing import Reference, scene, step, walker
from worker.simulation.sensors.frames import Frames
from worker.simulation.sensors.imu import Imu
from worker.simulation.sensors.momentum import AngularMomentum
from worker.simulation.sensors.sensor import SensorContext, SensorDeclaration

CONTROLS = np.array([[0.3, -0.4], [-0.5, 1.5]], np.float32)
"""Torques of the walker's legs in two worlds."""
SWING = """<mujoco><worldbody><body name="base" pos="0.3 0 1" euler="10 20 30">
  <geom name="base" type="box" size="0.1 0.1 0.1" mass="1"/>
  <body name="gimbal" pos="0.1 0 0"><joint name="slide" type="slide" axis="1 0 0" stiffness="30"/>
    <joint name="yaw" axis="0 0 1"/><joint name="pitch" axis="0 1 0"/>
    <geom name="gimbal" type="box" size="0.05 0.04 0.03" pos="0.2 0 0.1" mass="0.5"/>
    <body name="tip" pos="0.4 0 0"><joint name="tip" axis="0 1 0.3" damping="0.05"/>
      <geom name="tip" type="capsule" fromto="0 0 0 0.3 0 0" size="0.02" mass="0.3"/>
      <site name="imu" pos="0.2 0.01 0" euler="0 40 10"/></body></body></body>
  </worldbody><actuator><motor name="yaw" joint="yaw"/><motor name="tip" joint="tip"/></actuator>{}</mujoco>"""
"""An arm that is fixed to the world; three joints are on one body, those that shift first: Newton knows no other order."""


def swing(sensors: str = "") -> str:
    return SWING.format(f"<sensor>{sensors}</sensor>")


def imu_sensors(site: str) -> str:
    """An inertial measurement unit as MuJoCo has it."""
    parts = "".join(f'<{part} name="{part}" site="{site}"/>' for part in ("gyro", "accelerometer", "velocimeter"))
    return f'{parts}<framequat name="quat" objtype="site" objname="{site}"/>'


def xyzw(wxyz: np.ndarray) -> np.ndarray:
    return np.roll(wxyz, -1)


def same_rotation(one: np.ndarray, two: np.ndarray, tolerance: float = 1e-5) -> bool:
    """Whether two quaternions turn alike: q and -q do."""
    return abs(abs(float(one @ two)) - 1.0) < tolerance


def assert_imu_follows(context: SensorContext, text: str, site: str, steps: int, integrator: int, exact: float) -> None:
    """Let the worlds move, and compare each step of both with MuJoCo; ``exact`` is the tolerance of the accelerometer."""
    imu = Imu(site=site).build(context)
    reference = Reference(text, integrator=integrator)
    spread = []
    for _ in range(steps):
        accelerations = []
        for world in range(2):
            reference.take(context, world)
            accelerations.append(reference.sensor("accelerometer"))
        step(context, imu)
        arrays = imu.arrays
        np.testing.assert_allclose(arrays.accelerometer.numpy(), accelerations, rtol=exact, atol=10 * exact)
        for world in range(2):  # gyro and velocimeter are those of the present
            reference.take(context, world)
            np.testing.assert_allclose(arrays.gyro.numpy()[world], reference.sensor("gyro"), rtol=1e-3, atol=1e-3)
            speed = reference.sensor("velocimeter")
            np.testing.assert_allclose(arrays.velocimeter.numpy()[world], speed, rtol=1e-3, atol=1e-3)
            assert same_rotation(arrays.rotations.numpy()[world], xyzw(reference.sensor("quat")))
        spread.append(accelerations)
    assert np.std(spread, axis=0).min() > 0.01 and not np.allclose(*np.swapaxes(spread, 0, 1), rtol=0.05)


@pytest.mark.parametrize("site", ["imu", "left_sole"])
@pytest.mark.parametrize("integrator", ["euler", "implicitfast"])
def test_an_imu_on_a_robot_that_lands(site: str, integrator: str) -> None:
    text = walker(sensors=imu_sensors(site))
    context = scene({"robot": text}, integrator=integrator)
    context.worlds.arrays.controls.assign(CONTROLS)
    assert_imu_follows(context, text, site, 40, {"euler": 0, "implicitfast": 3}[integrator], 2e-3)


def test_an_imu_on_a_toe_with_a_ball_joint_in_the_air() -> None:
    site = '<site name="toe" pos="0.1 0.02 0" euler="0 0 50"/><geom name="toe"'
    text = walker(1.5, imu_sensors("toe")).replace('<geom name="toe"', site)
    context = scene({"robot": text})
    velocities = context.worlds.arrays.joint_qd.numpy()
    velocities[:, 3:] = np.random.default_rng(1).normal(size=velocities[:, 3:].shape) * 3
    context.worlds.arrays.joint_qd.assign(velocities)
    context.worlds.simulate()  # the solver has these velocities from here on
    context.worlds.arrays.controls.assign(CONTROLS)
    assert_imu_follows(context, text, "toe", 25, 0, 2e-3)


def test_an_imu_beyond_several_joints_on_one_body() -> None:
    text = swing(imu_sensors("imu"))
    context = scene({"robot": text})
    context.worlds.arrays.controls.assign(np.array([[2.0, 0.3], [-1.0, -0.2]], np.float32))
    assert_imu_follows(context, text, "imu", 60, 0, 2e-3)


def test_the_imu_of_a_world_that_was_placed_afresh_is_at_rest() -> None:
    context = scene({"robot": walker()})
    imu = Imu(body="trunk").build(context)
    for _ in range(30):
        step(context, imu)
    before = imu.arrays.accelerometer.numpy()
    context.worlds.restore_defaults()
    coordinates = context.worlds.arrays.joint_q.numpy()
    coordinates[:, 3:7] = [0.0, np.sin(0.3), 0.0, np.cos(0.3)]  # 0.6 rad about y
    context.worlds.arrays.joint_q.assign(coordinates)
    context.worlds.update_bodies()
    context.episodes.ages.assign(np.array([5, 0], np.int32))
    imu.settle()
    np.testing.assert_allclose(imu.arrays.accelerometer.numpy()[0], before[0])
    at_rest = [-9.81 * np.sin(0.6), 0.0, 9.81 * np.cos(0.6)]
    np.testing.assert_allclose(imu.arrays.accelerometer.numpy()[1], at_rest, atol=1e-4)
    assert not imu.arrays.gyro.numpy().any() and not imu.arrays.velocimeter.numpy().any()


def frame_sensors(kind: str, names: list[str], reference: str = "") -> str:
    form = '<{0} name="{0}_{1}" objtype="{2}" objname="{1}" {3}/>'
    parts = ("framepos", "framequat", "framelinvel", "frameangvel")
    return "".join(form.format(part, name, kind, reference) for part in parts for name in names)


@pytest.mark.parametrize(
    ("declared", "kind", "reference"),
    [
        (Frames(bodies=["trunk", "left", "toe", "right"]), "xbody", ""),
        (Frames(sites="*"), "site", ""),
        (Frames(bodies=["left", "toe"], relative_to="trunk"), "xbody", 'reftype="xbody" refname="trunk"'),
        (Frames(sites="left_sole", relative_to_site="imu"), "site", 'reftype="site" refname="imu"'),
        (Frames(bodies=["trunk", "toe"], relative_to_site="left_sole"), "xbody", 'reftype="site" refname="left_sole"'),
    ],
    ids=["bodies", "sites", "bodies seen from the trunk", "a site seen from a site", "bodies seen from a site"],
)
def test_frames_are_those_of_mujoco_s_sensors(declared: Frames, kind: str, reference: str) -> None:
    context = scene({"robot": walker()})
    context.worlds.arrays.controls.assign(CONTROLS)
    frames = declared.build(context)
    engine = Reference(walker(sensors=frame_sensors(kind, list(frames.names), reference)))
    for number in range(30):
        step(context, frames)
        arrays = frames.arrays
        for world in range(2) if number % 3 == 0 else ():
            engine.take(context, world)
            for column, name in enumerate(frames.names):
                for part, array in (("pos", arrays.positions), ("linvel", arrays.linear), ("angvel", arrays.angular)):
                    measured = array.numpy()[world, column]
                    expected = engine.sensor(f"frame{part}_{name}")
                    np.testing.assert_allclose(measured, expected, rtol=2e-3, atol=1e-3, err_msg=f"{part} {name}")
                rotation = arrays.rotations.numpy()[world, column]
                assert same_rotation(rotation, xyzw(engine.sensor(f"framequat_{name}")))
    assert not np.allclose(arrays.linear.numpy()[0], arrays.linear.numpy()[1], rtol=0.05)


def test_a_frame_seen_from_another_object_and_one_fixed_to_the_world() -> None:
    target = '<mujoco><worldbody><site name="goal" pos="1 0 0"/>{}</worldbody></mujoco>'.format(
        '<body name="cube" pos="0 2 1"><freejoint/><geom name="cube" type="box" size="0.1 0.1 0.1" mass="1"/></body>'
    )
    context = scene({"robot": walker(1.0), "target": target}, 1)
    cube = Frames(bodies="cube", robot="target", relative_to="trunk", reference_robot="robot").build(context)
    goal = Frames(sites="goal", robot="target").build(context)
    for _ in range(5):
        step(context, cube, goal)  # all fall alike
    np.testing.assert_allclose(cube.arrays.positions.numpy()[0, 0], [0, 2, 0], atol=1e-3)
    np.testing.assert_allclose(goal.arrays.positions.numpy()[0, 0], [1, 0, 0])
    assert not goal.arrays.linear.numpy().any()


@pytest.mark.parametrize(("body", "root"), [(None, "trunk"), ("left", "left"), ("toe", "toe")])
def test_momenta_are_those_of_mujoco_s_subtrees(body: str | None, root: str) -> None:
    names = ("subtreeangmom", "subtreelinvel", "subtreecom")
    parts = "".join(f'<{name} name="{name}" body="{root}"/>' for name in names)
    context = scene({"robot": walker()})
    context.worlds.arrays.controls.assign(CONTROLS)
    sensor = AngularMomentum(body=body).build(context)
    engine = Reference(walker(sensors=parts))
    for number in range(30):
        step(context, sensor)
        for world in range(2) if number % 3 == 0 else ():
            engine.take(context, world)
            arrays = sensor.arrays
            for part, array in (("angmom", arrays.angular), ("linvel", arrays.velocities), ("com", arrays.centers)):
                expected = engine.sensor(f"subtree{part}")
                np.testing.assert_allclose(array.numpy()[world], expected, rtol=2e-3, atol=1e-5, err_msg=part)
    np.testing.assert_allclose(sensor.arrays.masses.numpy(), engine.model.body(root).subtreemass[0], rtol=1e-5)
    assert np.linalg.norm(sensor.arrays.velocities.numpy()[0] - sensor.arrays.velocities.numpy()[1]) > 0.01


def test_momentum_of_a_heavier_world_is_greater() -> None:
    context = scene({"robot": walker(2.0)})
    sensor = AngularMomentum().build(context)
    for array in (context.worlds.model.body_mass, context.worlds.model.body_inertia):
        rows = array.numpy()
        rows[len(rows) // 2 :] *= 2.0
        array.assign(rows)
    context.worlds.arrays.joint_qd.fill_(1.0)
    context.worlds.update_bodies()
    sensor.advance()
    angular = sensor.arrays.angular.numpy()
    np.testing.assert_allclose(angular[1], 2 * angular[0], rtol=1e-4)
    assert np.linalg.norm(angular[0]) > 0.01


@pytest.fixture(scope="module")
def walking() -> SensorContext:
    return scene({"robot": walker()}, 1)


@pytest.mark.parametrize(
    ("declared", "parts"),
    [
        (Frames(), ["Frames: give either bodies or sites"]),
        (Frames(bodies="trunk", relative_to="*"), ["Frames.relative_to: name one body or site", "trunk, left"]),
        (Frames(bodies="trunk", relative_to="t", relative_to_site="imu"), ["either relative_to, a body, or"]),
        (Frames(bodies="trunk", reference_robot="robot"), ["Frames.reference_robot: name its body"]),
        (Frames(sites="sole"), ["no site of robot matches 'sole'", "left_sole"]),
        (Imu(), ["Imu: give either body or site"]),
        (Imu(site="*"), ["Imu: name one body or site", "imu, left_sole"]),
        (Imu(body="trunk", robot="rbt"), ["Imu.robot: there is no robot 'rbt'"]),
        (AngularMomentum(robot="rbt"), ["AngularMomentum.robot: there is no robot 'rbt'"]),
        (AngularMomentum(body="*t"), ["AngularMomentum.body: name one body", "left, right"]),
    ],
)
def test_a_sensor_that_can_t_be_built_is_refused_in_one_line(
    walking: SensorContext, declared: SensorDeclaration, parts: list[Any]
) -> None:
    output = refusal(declared.build, walking)
    assert all(part in output for part in parts), output


def test_an_imu_on_a_body_fixed_to_the_world_is_refused() -> None:
    context = scene({"robot": swing().replace('<body name="base"', '<site name="post"/><body name="base"')}, 1)
    with pytest.raises(ValueError, match="Imu: post is fixed to the world, so it never moves"):
        Imu(site="post").build(context)
