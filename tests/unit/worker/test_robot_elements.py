"""Elements of robot files that can't be held are refused by name; what has nothing to do with the motion is noted."""

from __future__ import annotations

import numpy as np
import pytest

from tests.support.worker.robot_texts import BOX, HINGE, SECOND, mjcf, read, twins
from worker.simulation.robot_view import RobotView

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
        ('value="1"', 'value="-1"', r"link a: its mass is -1; give it one greater than 0"),
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
            "MuJoCo ignores an empty range: joint j (0.5 to 0.3)",
        ),
        (
            urdf(limit='<limit effort="5" velocity="3"/>'),
            "joints without <limit>, or whose lower and upper are both 0, move without end, as in MuJoCo: j",
        ),
        (urdf(limit=LIMIT.replace("5", "-5")), "MuJoCo ignores a negative effort: joint j"),
        (
            mjcf(f'<joint name="j" axis="0 1 0" range="30 -30"/>{BOX}'),
            "MuJoCo ignores an empty range: joint j (30 to -30)",
        ),
        (
            mjcf(HINGE + BOX, '<actuator><motor joint="j" ctrlrange="1 -1"/></actuator>'),
            "MuJoCo ignores an empty ctrlrange: actuator actuator_0 (1 to -1)",
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


def test_flags_that_do_not_move_it_do_not_make_another_robot() -> None:
    flags = '<flag energy="enable" fwdinv="enable" midphase="disable" autoreset="disable"/>'
    assert not read(mjcf(HINGE + BOX, before=f"<option>{flags}</option>")).corrected


def test_a_missing_height_field_is_refused() -> None:
    with pytest.raises(ValueError, match=r"its height field nope\.png is missing"):
        read(mjcf(HINGE + BOX, before='<asset><hfield name="h" file="nope.png" size="1 1 1 1"/></asset>'))


@pytest.mark.parametrize(("density", "is_refused"), [("0", False), ("1", True)])
def test_the_shape_of_a_geom_in_a_medium_counts_where_there_is_one(density: str, is_refused: bool) -> None:
    """The medium acts on the axes of inertia, so that they are all different."""
    moments = '<inertial pos="0 0 0" mass="1" diaginertia=".1 .15 .2"/>'
    shape = BOX.replace("/>", ' fluidshape="ellipsoid"/>')
    file = mjcf(HINGE + moments + shape, before=f'<option density="{density}"/>')
    if not is_refused:
        assert not read(file).corrected
        return
    with pytest.raises(ValueError, match=r"geom geom_0: fluid is .*Leave out fluidshape"):
        read(file)


@pytest.mark.parametrize(
    ("joint", "motor", "limits"),
    [
        ("", 'forcerange="-inf inf"', (-np.inf, np.inf)),
        ("", 'ctrlrange="-inf inf"', (-np.inf, np.inf)),
        ("", 'forcerange="-inf 3"', (-np.inf, np.inf)),
        ('range="-inf inf"', "", (-np.inf, np.inf)),
        ('range="-inf 1"', "", (-np.inf, 1.0)),
        ('range="-1 inf" springdamper=".1 1"', "", (-1.0, np.inf)),
        ('actuatorfrcrange="-inf inf"', "", (-np.inf, np.inf)),
    ],
)
def test_ranges_may_be_open(joint: str, motor: str, limits: tuple[float, float]) -> None:
    reading = read(
        mjcf(
            f'<joint name="j" axis="0 1 0" {joint}/>{BOX}',
            f'<actuator><motor joint="j" {motor}/></actuator>',
            '<compiler angle="radian"/>',
        )
    )
    assert RobotView(reading.builder, "").ranges == [limits] and not reading.notes


@pytest.mark.parametrize(("kind", "is_lost"), [("box", True), ("sphere", False)])
def test_margins_that_newton_leaves_out_are_noted(kind: str, is_lost: bool) -> None:
    """Of all geoms and contact pairs where one geom is a box."""
    geom = '<geom name="{}" type="{}" size=".1 .1 .1" pos="0 {} 0" margin="{}"/>'
    bodies = HINGE + geom.format("g", "sphere", 1, 0.02) + f'<body name="c">{geom.format("h", kind, 2, 0)}</body>'
    reading = read(mjcf(bodies, '<contact><pair geom1="g" geom2="h" margin=".01"/></contact>'))
    lost = (
        "contacts begin where geoms touch, not at the margin of the file (geom g, contact pair 0): "
        "Newton leaves out the margins of all geoms where one is a box or, with multiccd, a mesh"
    )
    assert reading.notes == ((lost,) if is_lost else ())


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


@pytest.mark.parametrize(
    ("file", "words"),
    [
        (
            mjcf(HINGE + BOX, '<actuator><motor joint="jj"/></actuator>'),
            r"unknown transmission target 'jj'.*did you mean j\?",
        ),
        (
            mjcf(f'{HINGE}<geom size=".1" mass="0"/>'),
            r"moving bodies must be larger than mjMINVAL Element name 'b'.*give that body",
        ),
        (
            mjcf(f'<joint name="j" axis="0 1 0" damping=".5 .2"/>{BOX}'),
            r"another robot here: joint j: dampingpoly is \(0 0\), in the file \(0.2 0\)\. Give damping one number",
        ),
        (
            mjcf(f'<joint name="j" type="ball" range="0 1" limited="true"/>{BOX}'),
            r"joint j: limited is False, in the file True",
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
        (
            mjcf(f'<joint name="j" axis="0 1 0" actuatorfrcrange="-2 3"/>{BOX}'),
            r"actuatorfrcrange is \(-3 3\), in the file \(-2 3\)\. Make it symmetric, or give the actuator a forcerange",
        ),
        (
            mjcf(
                HINGE + BOX,
                '<actuator><motor joint="j"/><plugin name="act" joint="j" plugin="mujoco.pid" instance="p"/></actuator>',
                '<extension><plugin plugin="mujoco.pid"><instance name="p"/></plugin></extension>',
            ),
            r"actuator act: plugin is missing, in the file there\. Leave the plugin out",
        ),
        (
            mjcf(
                f'{HINGE}{BOX}<flexcomp name="f" type="grid" count="3 3 1" spacing=".1 .1 .1" dim="2" radius=".01" mass="1"/>'
            ),
            r"flex f: flexible body is missing, in the file there\. Leave out the flexible body",
        ),
        ("", r"a robot needs a file"),
    ],
)
def test_what_can_t_be_held_is_refused_by_the_name_of_its_element(file: str, words: str) -> None:
    with pytest.raises(ValueError, match=rf"^robot: .*{words}") as caught:
        read(file)
    assert "\n" not in str(caught.value)
