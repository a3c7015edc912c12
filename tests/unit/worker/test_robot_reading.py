"""A robot is what its file says, as MuJoCo's compiler reads it, or it is refused by the name of the element."""

from __future__ import annotations

import dataclasses
from typing import Any

import mujoco
import newton
import numpy as np
import pytest
from newton.solvers import SolverMuJoCo

from worker.accepting import CHANGED_ROBOTS
from worker.simulation.robot import Robot
from worker.simulation.robot_identity import identity
from worker.simulation.robot_reading import Reading
from worker.simulation.robot_twins import Twins
from worker.simulation.robot_view import RobotView
from worker.simulation.worlds import Worlds

BOX = '<geom type="box" size=".1 .1 .1" pos=".2 0 -.1" mass="1" contype="0" conaffinity="0"/>'
"""A geom that touches nothing, beside the joints of its body."""


def mjcf(body: str, rest: str = '<actuator><motor joint="j"/></actuator>', before: str = "") -> str:
    return f'<mujoco>{before}<worldbody><body name="b" pos="0 0 1">{body}</body></worldbody>{rest}</mujoco>'


HINGE = '<joint name="j" axis="0 1 0"/>'
SECOND = f'<body name="c" pos="0 0 -.6"><joint name="k" axis="0 1 0"/>{BOX}</body>'
OTHERWISE = {
    "another anchor of each joint": mjcf(f'{HINGE}<joint name="k" axis="1 0 0" pos="0 0 .5"/>{BOX}'),
    "a hinge before a slide": mjcf(f'{HINGE}<joint name="k" type="slide" axis="1 0 0"/>{BOX}'),
    "a slide before a ball": mjcf(
        f'<joint name="j" type="slide" axis="1 0 0"/><joint name="k" type="ball" pos=".1 0 0"/>{BOX}'
    ),
    "a total mass": mjcf(HINGE + BOX, before='<compiler settotalmass="7"/>'),
    "replicated bodies": mjcf(
        f'{HINGE}{BOX}<replicate count="3" offset="0 .3 0"><body pos="0 0 -.3"><joint/>{BOX}</body></replicate>'
    ),
    "a composite": mjcf(
        f'{HINGE}{BOX}<composite type="cable" curve="s" count="4 1 1" size=".5" offset=".1 0 0" initial="none">'
        '<geom type="capsule" size=".01"/></composite>'
    ),
    "actuators of rare kinds": mjcf(
        HINGE + BOX,
        '<actuator><motor joint="j"/><damper joint="j" kv="5" ctrlrange="0 1"/>'
        '<cylinder joint="j" timeconst=".1" area="2"/></actuator>',
    ),
    "a filtered servo": mjcf(HINGE + BOX, '<actuator><position joint="j" kp="100" timeconst=".2"/></actuator>'),
    "a tendon over joints of one body": mjcf(
        f'<joint name="i" axis="1 0 0"/>{HINGE}{BOX}{SECOND}',
        '<tendon><fixed name="t" stiffness="40"><joint joint="j" coef="1"/><joint joint="k" coef="-1"/></fixed></tendon>'
        '<actuator><motor tendon="t" gear="3"/></actuator>',
    ),
    "an equality over joints of one body": mjcf(
        f'<joint name="i" axis="1 0 0" pos="0 0 .2"/>{HINGE}{BOX}{SECOND}',
        '<equality><joint joint1="k" joint2="i" polycoef="0 2 0 0 0"/></equality><actuator><motor joint="j"/></actuator>',
    ),
    "a spring by its frequency": mjcf(f'<joint name="j" axis="0 1 0" springdamper=".1 1"/>{BOX}'),
    "defaults of all actuators": mjcf(
        HINGE + BOX,
        '<actuator><motor class="h" joint="j"/></actuator>',
        '<default><default class="h"><general gear="3"/></default></default>',
    ),
    "a name of the topmost defaults": mjcf(
        HINGE + BOX,
        before='<default class="main"><joint damping="3" armature=".2"/><motor ctrllimited="true" ctrlrange="-1 1" gear="4"/></default>',
    ),
    "another gravity": mjcf(HINGE + BOX, before='<option gravity="0 1 -3"/>'),
    "the solver PGS": mjcf(HINGE + BOX, before='<option solver="PGS"/>'),
    "a very light body": mjcf(f'{HINGE}<geom size=".001" mass="1e-5"/>'),
    "names that differ in their dashes alone": mjcf(
        f'{HINGE}{BOX}<body name="a-b" pos="0 0 -.2"><joint name="k-l" pos="0 0 .1"/><joint name="k_l" axis="1 0 0"/>{BOX}</body>'
        f'<body name="a_b" pos="0 .5 0"><joint axis="0 1 0"/>{BOX}</body>'
    ),
    "names with slashes": mjcf(
        f'<joint name="r/j" axis="0 1 0" springdamper=".1 1"/>{BOX}', '<actuator><motor joint="r/j"/></actuator>'
    ),
    "sites by the topmost defaults": mjcf(
        f'{HINGE}{BOX}<site name="s"/>', before='<default class="main"><site pos=".1 .2 .3"/></default>'
    ),
}
"""Files that Newton's importer builds as another robot, or can't read."""
SAME = {
    "a ball joint on its own": mjcf(
        f'<joint name="k" type="ball" pos=".1 0 0" damping=".1"/>{BOX}{SECOND.replace("k", "j")}'
    ),
    "a plain hinge": mjcf(HINGE + BOX),
    "a free body": mjcf(f"<freejoint/>{BOX}{SECOND.replace('k', 'j')}"),
    "stacked joints in Newton's order": mjcf(f'<joint name="k" type="slide" axis="1 0 0"/>{HINGE}{BOX}'),
}
"""Files that it reads as MuJoCo does."""


def read(file: str, **options: Any) -> Reading:
    return Robot(file, passive=True, **options).read()


def twins(reading: Reading) -> Twins:
    assert reading.reference is not None
    return Twins(reading.reference.model, reading.builder)


def stepped(model: Any, columns: list[int], controls: Any) -> Any:
    """Coordinates after a second of MuJoCo's own engine."""
    data = mujoco.MjData(model)
    data.ctrl[:] = controls
    for _ in range(500):
        mujoco.mj_step(model, data)
    return data.qpos[columns]


@pytest.mark.parametrize("file", OTHERWISE.values(), ids=OTHERWISE)
def test_a_file_that_newton_reads_otherwise_becomes_the_robot_that_mujoco_compiles(file: str) -> None:
    reading = read(file)
    assert reading.corrected
    both = twins(reading)
    there, here = both.free_of_contacts()
    for field in ("nq", "nv", "nu", "na", "ntendon", "neq"):
        assert getattr(here, field) == getattr(there, field)
    assert here.body_mass.sum() == pytest.approx(there.body_mass.sum(), rel=1e-6)
    first, second = both.columns()
    controls = np.full(there.nu, 0.2)
    np.testing.assert_allclose(stepped(here, second, controls), stepped(there, first, controls), atol=1e-4)


@pytest.mark.parametrize("file", SAME.values(), ids=SAME)
def test_a_file_that_newton_reads_as_mujoco_does_stays_as_newton_reads_it(file: str) -> None:
    assert not read(file).corrected


def test_worlds_move_such_a_robot_as_mujoco_does() -> None:
    robot = Robot(OTHERWISE["another anchor of each joint"])
    builder = newton.ModelBuilder()
    SolverMuJoCo.register_custom_attributes(builder)
    robot.add_to(builder)
    view = RobotView(builder)
    assert view.body_names == ["b"] and view.joint_names == ["j", "k"]
    worlds = Worlds(
        builder, 2, "cpu", timestep=0.002, substeps=50, fastest=1e9, solver_options={"njmax": 20, "nconmax": 5}
    )
    worlds.arrays.controls.fill_(0.2)
    for _ in range(10):
        worlds.simulate()
    model = mujoco.MjModel.from_xml_string(str(robot.file))
    model.opt.integrator = int(mujoco.mjtIntegrator.mjINT_IMPLICITFAST)
    np.testing.assert_allclose(worlds.solver.mjw_data.qpos.numpy(), [stepped(model, [0, 1], 0.2)] * 2, atol=1e-3)
    worlds.update_bodies()
    data = mujoco.MjData(model)
    data.qpos[:] = worlds.arrays.joint_q.numpy()[0]
    mujoco.mj_kinematics(model, data)
    np.testing.assert_allclose(worlds.state.body_q.numpy()[view.bodies[0], :3], data.xpos[1], atol=1e-5)


def test_parents_and_children_stay_apart_where_carriers_stand_between_them() -> None:
    touching = '<geom size=".1" mass="1"/>'
    stack = '<joint name="k" axis="0 1 0"/><joint name="l" axis="1 0 0" pos="0 0 .1"/>'
    reading = read(mjcf(f'<freejoint name="j"/>{touching}<body name="c" pos="0 0 .05">{stack}{touching}</body>', ""))
    assert reading.corrected and not reading.notes


URDF = """<robot name="r"><link name="base"/><link name="a"><inertial><origin xyz=".5 0 0"/><mass value="1"/>
<inertia ixx="{xx}" iyy=".01" izz=".01" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="j" type="{kind}"><parent link="base"/><child link="a"/><origin xyz="0 0 1"/><axis xyz="0 1 0"/>{limit}</joint>
{more}</robot>"""
LIMIT = '<limit lower="-0.3" upper="0.3" effort="5" velocity="3"/>'


def urdf(kind: str = "revolute", limit: str = LIMIT, more: str = "", xx: float = 0.01) -> str:
    return URDF.format(kind=kind, limit=limit, more=more, xx=xx)


def test_limits_of_a_urdf_joint_are_as_stiff_as_mujoco_s() -> None:
    reading = read(urdf())
    assert [(each.element, each.field) for each in reading.corrected] == [("joint j", "solref")]
    np.testing.assert_allclose(twins(reading).built.jnt_solref, [[0.02, 1.0]], rtol=1e-6)


def test_impossible_inertias_of_a_urdf_file_are_corrected_by_name() -> None:
    (note,) = read(urdf(xx=1.0)).notes
    assert note.startswith("body a: no body has the principal moments of inertia ") and "0.34 0.34 0.34" in note


def test_a_mimic_joint_follows() -> None:
    link = '<link name="c"><inertial><mass value="1"/><inertia ixx=".01" iyy=".01" izz=".01" ixy="0" ixz="0" iyz="0"/></inertial></link>'
    joint = f'<joint name="k" type="revolute"><parent link="a"/><child link="c"/><axis xyz="0 1 0"/>{LIMIT}<mimic joint="j" multiplier="-2"/></joint>'
    reading = read(urdf(more=link + joint))
    np.testing.assert_allclose(twins(reading).built.eq_data[0, :2], [0.0, -2.0])


@pytest.mark.parametrize(
    ("file", "words"),
    [
        (
            mjcf(HINGE + BOX, '<actuator><motor joint="jj"/></actuator>'),
            r"unknown transmission target 'jj'.*did you mean j\?",
        ),
        (
            mjcf(HINGE + BOX, '<actuator><position joint="j" kp="nan"/></actuator>'),
            r"kp='nan' of <position name=''> is not a number",
        ),
        (
            mjcf(f'{HINGE}<geom size=".1" mass="0"/>'),
            r"moving bodies must be larger than mjMINVAL Element name 'b'.*give that body",
        ),
        (mjcf(f'{HINGE}<geom size=".1" mass="-1"/>'), r"negative in geom .*give a value of 0 or more"),
        (
            mjcf(f'<joint name="j" axis="0 1 0" damping=".5 .2"/>{BOX}'),
            r"another robot here: joint j: dampingpoly is \(0 0\), in the file \(0.2 0\)\. Give damping one number",
        ),
        (
            mjcf(HINGE + BOX, '<actuator><position joint="j" kp="20" nsample="8" delay=".01"/></actuator>'),
            r"actuator actuator_0: delay is 0, in the file 0.01, and 1 more\. Declare the delay in the task",
        ),
        (
            mjcf(f'<joint name="j" type="ball" range="0 1" limited="true"/>{BOX}'),
            r"joint j: limited is False, in the file True",
        ),
        (
            mjcf(f'<joint name="j" type="free" damping=".1"/>{BOX}'),
            r"joint j: damping is \(0 0 0 0 0 0\), in the file \(0.1 0.1",
        ),
        (urdf("spherical"), r"joint j is of type 'spherical'; URDF has revolute, continuous"),
        (
            urdf(more='<joint name="k" type="fixed"><parent link="base"/><child link="a"/></joint>'),
            r"link a closes a loop: the joints j and k both move it; leave out one",
        ),
        ("", r"a robot needs a file"),
    ],
)
def test_what_can_t_be_held_is_refused_by_the_name_of_its_element(file: str, words: str) -> None:
    with pytest.raises(ValueError, match=rf"^robot: .*{words}") as caught:
        read(file)
    assert "\n" not in str(caught.value)


def test_a_keyframe_does_not_forbid_another_root() -> None:
    posed = mjcf(f"<freejoint/>{BOX}{SECOND.replace('k', 'j')}", '<keyframe><key qpos="0 0 1 1 0 0 0 .3"/></keyframe>')
    assert read(posed, fixed=True).reference is not None


@pytest.mark.parametrize("named", [True, False])
def test_the_integrator_is_the_file_s_where_it_names_one(named: bool) -> None:
    option = '<option integrator="Euler"/>' if named else ""
    for body in (HINGE, '<joint name="j" axis="0 1 0" springdamper=".1 1"/>'):  # read as it is, and rewritten
        values: Any = read(mjcf(body + BOX, before=option)).builder.custom_attributes["mujoco:integrator"].values
        assert (values or {}).get(0) == (0 if named else None)


def test_a_difference_may_be_accepted() -> None:
    delayed = mjcf(HINGE + BOX, '<actuator><position joint="j" kp="20" nsample="8" delay=".01"/></actuator>')
    assert read(delayed, accept=("actuator *: delay", "actuator *: history")).reference is not None


def test_a_job_that_accepts_changed_robots_has_the_robot_that_newton_reads() -> None:
    delayed = mjcf(HINGE + BOX, '<actuator><position joint="j" kp="20" nsample="8" delay=".01"/></actuator>')
    accepted = CHANGED_ROBOTS.set(True)
    try:
        (note,) = read(delayed).notes
    finally:
        CHANGED_ROBOTS.reset(accepted)
    assert note.startswith("loaded as Newton's importer reads it, since changed robots are accepted: ")
    assert "delay is 0, in the file 0.01" in note


@pytest.mark.parametrize("name", ["joint_positions", "armature"])
def test_numbers_of_joints_are_finite(name: str) -> None:
    with pytest.raises(ValueError, match=rf"^Robot robot: {name} is .*; give finite numbers$"):
        Robot(mjcf(HINGE + BOX), **{name: {"j": float("nan")}})


def test_a_default_pose_beyond_the_limits_is_noted() -> None:
    limited = mjcf(f'<joint name="j" axis="0 1 0" range="-60 60"/>{BOX}')
    builder = newton.ModelBuilder()
    SolverMuJoCo.register_custom_attributes(builder)
    Robot(limited, joint_positions={"j": 3.0}).add_to(builder)
    assert RobotView(builder).beyond_limits() == [
        "joint j: its default position 3 lies outside its limits, -1.0472 to 1.0472"
    ]


def test_the_identity_of_a_robot_is_the_same_where_a_processor_rounds_otherwise() -> None:
    reading = read(SAME["a plain hinge"])
    assert reading.reference is not None
    model, random = reading.reference.model, np.random.default_rng(0)
    for field in ("body_pos", "body_quat", "body_inertia", "geom_pos", "geom_quat", "jnt_axis"):
        array = getattr(model, field)
        array += 1e-16 * random.standard_normal(array.shape)
    assert identity(reading.builder, model) == reading.identity


def test_the_identity_of_a_robot_follows_its_model_and_not_its_notation() -> None:
    heavier = SAME["a plain hinge"].replace('mass="1"', 'mass="1.5"')
    noted = SAME["a plain hinge"].replace("<mujoco>", "<mujoco><!-- the same -->")
    plain, other, same = (read(file).identity for file in (SAME["a plain hinge"], heavier, noted))
    assert plain == same and plain.digest != other.digest
    elements = {**plain.elements, "body b": {"mass": 1.5}}
    assert dataclasses.replace(plain, digest="", mass=1.5, elements=elements) == dataclasses.replace(other, digest="")
