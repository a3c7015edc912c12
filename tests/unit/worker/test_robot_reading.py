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
from worker.simulation import robot_judge
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
SITE = '<site name="t" pos="0 .1 0"/>'
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
    "a weld of two sites": mjcf(
        f'<site name="s" pos=".1 0 0" euler="0 40 0"/>{HINGE}{BOX}{SECOND.replace(BOX, SITE + BOX)}',
        '<equality><weld site1="t" site2="s"/></equality><actuator><motor joint="j"/></actuator>',
    ),
    "an adhesion": mjcf(
        HINGE + BOX + SECOND,
        '<actuator><adhesion body="c" gain="2" ctrlrange="0 1"/><motor joint="j"/></actuator>',
    ),
}
"""Files that Newton's importer builds as another robot, or can't read."""
SAME = {
    "equalities of several kinds": mjcf(
        HINGE + BOX + SECOND,
        '<tendon><fixed name="t"><joint joint="j" coef="1"/></fixed></tendon><equality><joint name="y" joint1="k"/>'
        '<connect body1="c" body2="b" anchor="0 0 .6"/><weld body1="c"/><joint joint1="j" joint2="k"/><tendon tendon1="t"/>'
        '<weld name="x" body1="c" body2="b"/></equality><actuator><motor joint="j"/></actuator>',
    ),
    "tendons of both kinds": mjcf(
        f'<site name="s" pos=".1 0 0"/>{HINGE}{BOX}{SECOND.replace(BOX, SITE + BOX)}',
        '<tendon><spatial><site site="s"/><site site="t"/></spatial><fixed><joint joint="j" coef="2"/></fixed></tendon>'
        '<actuator><motor joint="j"/></actuator>',
    ),
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


NAMED = SECOND.replace("<geom", '<geom name="i"')
ENDS = mjcf(
    f'{HINGE}{BOX}<site name="s"/><site name="t" pos="0 .1 0"/><site name="u" pos=".1 0 0"/>{NAMED}<geom name="g" size=".1" mass="1" contype="0" conaffinity="0"/>'
    f'<geom name="h" size=".1" pos="0 0 .3" mass="1" contype="0" conaffinity="0"/>',
    '<tendon><fixed name="e"><joint joint="j" coef="1"/></fixed><fixed name="f"><joint joint="k" coef="1"/></fixed>{tendon}</tendon>'
    '<equality>{equality}</equality><contact>{pair}</contact><actuator>{actuator}<motor joint="j"/></actuator>',
)
"""A robot with elements that connect others."""


def ends(tendon: str = "", equality: str = "", actuator: str = "", pair: str = "") -> str:
    return ENDS.format(tendon=tendon, equality=equality, actuator=actuator, pair=pair)


@pytest.mark.parametrize(
    ("kind", "element", "here", "there", "words"),
    [
        ("equality", '<connect body1="{}" anchor="0 0 0" active="false"/>', "b", "c", "equality equality_0: body1"),
        ("equality", '<weld body1="c" body2="{}" active="false"/>', "b", "world", "equality equality_0: body2"),
        ("equality", '<weld body1="c" anchor="{} 0 0" active="false"/>', "0", ".1", "equality equality_0: anchor2"),
        (
            "equality",
            '<weld body1="c" relpose="0 0 0 1 {} 0 0" active="false"/>',
            "0",
            ".1",
            "equality equality_0: turn",
        ),
        ("equality", '<weld body1="c" torquescale="{}" active="false"/>', "1", "2", "equality equality_0: torquescale"),
        ("equality", '<joint joint1="{}" active="false"/>', "j", "k", "equality equality_0: joint1"),
        (
            "equality",
            '<joint joint1="j" joint2="k" polycoef="0 {}" active="false"/>',
            "1",
            "2",
            "equality equality_0: polycoef",
        ),
        ("equality", '<tendon tendon1="{}" active="false"/>', "e", "f", "equality equality_0: tendon1"),
        ("actuator", '<motor joint="{}"/>', "j", "k", "actuator actuator_0: joint"),
        ("actuator", '<motor tendon="{}"/>', "e", "f", "actuator actuator_0: tendon"),
        ("actuator", '<motor site="{}"/>', "s", "t", "actuator actuator_0: site"),
        ("actuator", '<motor site="s" refsite="{}"/>', "s", "t", "actuator actuator_0: refsite"),
        (
            "actuator",
            '<motor cranksite="{}" slidersite="t" cranklength="1"/>',
            "s",
            "t",
            "actuator actuator_0: cranksite",
        ),
        ("actuator", '<adhesion body="{}" ctrlrange="0 1"/>', "b", "c", "actuator actuator_0: body"),
        ("tendon", '<fixed name="t"><joint joint="{}" coef="1"/></fixed>', "j", "k", "tendon t: path 0"),
        ("tendon", '<fixed name="t"><joint joint="j" coef="{}"/></fixed>', "1", "2", "tendon t: coefficients"),
        (
            "tendon",
            '<spatial name="t"><site site="s"/><geom geom="{}"/><site site="t"/></spatial>',
            "g",
            "h",
            "tendon t: path 1",
        ),
        ("tendon", '<spatial><site site="s"/><site site="{}"/></spatial>', "u", "t", "tendon tendon_2: existence"),
        ("pair", '<pair geom1="{}" geom2="i"/>', "g", "h", "contact pair 0: existence"),
    ],
)
def test_an_end_on_another_element_is_found(kind: str, element: str, here: str, there: str, words: str) -> None:
    built, reference = (
        read(ends(**{kind: element.format(here)})).builder,
        read(ends(**{kind: element.format(there)})).reference,
    )
    assert reference is not None
    found = [f"{each.element}: {each.field}" for each in robot_judge.compare(reference.model, built).differences]
    assert words in found


def test_sites_that_an_equality_pulls_together_are_held_where_they_are_together_at_first() -> None:
    file = mjcf(
        f'<site name="s" pos="0 0 -.6"/>{HINGE}{BOX}{SECOND.replace(BOX, SITE.replace(".1", "{}") + BOX)}',
        '<equality><connect site1="s" site2="t" active="false"/></equality><actuator><motor joint="j"/></actuator>',
    )
    assert read(file.format("0")).reference is not None
    with pytest.raises(
        ValueError, match=r"equality equality_0: anchor2 is \(0 0 0\), in the file \(0 0.1 0\)\. Let both sites"
    ):
        read(file.format(".1"))


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


@pytest.mark.parametrize(
    ("before", "after", "words"),
    [
        ('value="1"', 'value="inf"', r"link a: value='inf' of its <mass> is not a finite number"),
        ('value="1"', 'value="nan"', r"link a: value='nan' of its <mass> is not a finite number"),
        ('value="1"', 'value="-1"', r"link a: its mass is -1; give it one greater than 0"),
        ('iyy=".01"', 'iyy="inf"', r"link a: iyy='inf' of its <inertia> is not a finite number"),
        ('lower="-0.3"', 'lower="nan"', r"joint j: lower='nan' of its <limit> is not a finite number"),
    ],
)
def test_impossible_numbers_of_a_urdf_file_are_refused_by_link_or_joint(before: str, after: str, words: str) -> None:
    with pytest.raises(ValueError, match=rf"^robot: its XML: {words}"):
        read(urdf().replace(before, after))


@pytest.mark.parametrize(
    ("file", "words"),
    [
        (
            urdf(limit=LIMIT.replace("-0.3", "0.5")),
            "a range without values is no limit, as in MuJoCo: joint j (0.5 to 0.3)",
        ),
        (
            urdf(limit='<limit effort="5" velocity="3"/>'),
            "joints without <limit>, or whose lower and upper are both 0, move without end, as in MuJoCo: j",
        ),
        (urdf(limit=LIMIT.replace("5", "-5")), "a negative effort is no limit, as in MuJoCo: joint j"),
        (
            mjcf(f'<joint name="j" axis="0 1 0" range="30 -30"/>{BOX}'),
            "a range without values is no limit, as in MuJoCo: joint j (30 to -30)",
        ),
        (
            mjcf(HINGE + BOX, '<actuator><motor joint="j" ctrlrange="1 -1"/></actuator>'),
            "a ctrlrange without values is no limit, as in MuJoCo: actuator actuator_0 (1 to -1)",
        ),
    ],
)
def test_a_range_without_values_is_noted(file: str, words: str) -> None:
    assert read(file).notes == (words,)


def test_visuals_that_a_rebuilt_urdf_robot_loses_are_noted() -> None:
    visual = '<visual><geometry><box size="1 1 1"/></geometry></visual>'
    empty = urdf(limit=LIMIT.replace("-0.3", "0.5")).replace('<link name="a">', f'<link name="a">{visual}')
    assert read(empty).notes[-1] == "pictures lack the visuals of the file, since MuJoCo's compiled model has none"
    assert not read(urdf().replace('<link name="a">', f'<link name="a">{visual}')).notes


@pytest.mark.parametrize(
    ("asset", "missing"),
    [
        ('<texture name="t" type="2d" file="nope.png"/><material name="m" texture="t"/>', "nope.png"),
        ('<material name="m" texture="t"/>', "t"),
        ('<material name="m"><layer texture="t" role="rgb"/></material>', "t"),
        ('<skin name="s" file="nope.skn"/><material name="m"/>', "nope.skn"),
    ],
)
def test_a_missing_texture_or_skin_is_noted(asset: str, missing: str) -> None:
    painted = mjcf(HINGE + BOX.replace("/>", ' material="m"/>'), before=f"<asset>{asset}</asset>")
    reading = read(painted)
    assert reading.notes == (f"pictures lack textures or skins that the file names and that are missing ({missing})",)


@pytest.mark.parametrize(("geom", "is_lost"), [("mesh", True), ("box", False)])
def test_textures_that_a_rebuilt_robot_loses_are_noted(geom: str, is_lost: bool) -> None:
    assets = (
        '<texture name="t" type="2d" builtin="flat" width="8" height="8"/><material name="m" texture="t"/>'
        '<mesh name="v" vertex="0 0 0 .1 0 0 0 .2 0 0 0 .3"/>'
    )
    seen = f'<geom type="{geom}" size=".1 .1 .1" material="m" mass="1" contype="0" conaffinity="0"/>'
    spring = '<joint name="j" axis="0 1 0" springdamper=".1 1"/>'
    reading = read(mjcf(spring + seen.replace('"mesh"', '"mesh" mesh="v"'), before=f"<asset>{assets}</asset>"))
    assert reading.corrected and bool(reading.notes) == is_lost
    assert all("pictures lack the textures of the file" in note for note in reading.notes)


def test_a_light_with_a_texture_is_no_part_of_a_robot() -> None:
    texture = '<asset><texture name="t" type="2d" builtin="flat" width="8" height="8"/></asset>'
    assert not read(mjcf(f'{HINGE}{BOX}<light texture="t"/>', before=texture)).notes


def test_flags_that_only_report_do_not_make_another_robot() -> None:
    assert not read(mjcf(HINGE + BOX, before='<option><flag energy="enable" fwdinv="enable"/></option>')).corrected


def test_a_missing_height_field_is_refused() -> None:
    with pytest.raises(ValueError, match=r"its height field nope\.png is missing"):
        read(mjcf(HINGE + BOX, before='<asset><hfield name="h" file="nope.png" size="1 1 1 1"/></asset>'))


@pytest.mark.parametrize("fixed", [True, False])
@pytest.mark.parametrize(
    "rest",
    [
        '<actuator><motor joint="j"/></actuator>',
        '<tendon><fixed name="t"><joint joint="j" coef="1"/><joint joint="k" coef="1"/></fixed></tendon>',
        '<equality><joint joint1="k" joint2="j"/></equality>',
    ],
)
def test_a_root_s_joint_that_the_file_needs_is_not_taken(fixed: bool, rest: str) -> None:
    with pytest.raises(ValueError, match=rf"fixed={fixed} would take the joint j of the root b, .*; leave fixed out"):
        read(mjcf(HINGE + BOX + SECOND, rest), fixed=fixed)


def test_a_root_may_be_fixed_or_free() -> None:
    motor = '<actuator><motor joint="k"/></actuator>'
    free, hinged = mjcf(f'<freejoint name="j"/>{BOX}{SECOND}', motor), mjcf(HINGE + BOX + SECOND, motor)
    coordinates = {}
    for name, file in (("free", free), ("hinged", hinged)):
        for fixed in (True, False):
            reading = read(file, fixed=fixed)
            coordinates[name, fixed] = twins(reading).built.nq
    assert coordinates == {("free", True): 1, ("free", False): 8, ("hinged", True): 1, ("hinged", False): 8}
    driven = mjcf(f'<freejoint name="j"/>{BOX}{SECOND}', '<actuator><motor joint="j" gear="1 0 0 0 0 0"/></actuator>')
    assert twins(read(driven, fixed=False)).built.nu == 1


def test_a_mocap_body_stays_where_the_root_moves_freely() -> None:
    target = f'<mujoco><worldbody><body name="m" mocap="true"/><body name="b">{BOX}</body></worldbody></mujoco>'
    assert twins(read(target, fixed=False)).built.nq == 7


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
        (
            mjcf(f'{HINGE}<inertial pos="0 0 0" mass="nan" diaginertia="1 1 1"/>'),
            r"mass='nan' of <inertial name=''> in body b is not a number",
        ),
        (
            mjcf(
                HINGE + BOX, '<actuator><motor joint="j" group="3"/></actuator>', '<option actuatorgroupdisable="3"/>'
            ),
            r"option: disableactuator is 0, in the file 8",
        ),
        (
            mjcf(HINGE + BOX, before='<option density="1000"/>'),
            r"body b: axes of inertia is .*Give the body an <inertial> of three different moments",
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
