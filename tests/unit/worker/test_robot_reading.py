"""A robot is what its file says, as MuJoCo's compiler reads it, or it is refused by the name of the element."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
import pytest

from tests.support.worker.robot_texts import BOX, HINGE, SECOND, SITE, mjcf, read, template, twins
from worker.settings.accepted_changes import CHANGED_ROBOTS
from worker.simulation import robot_comparison as robot_judge
from worker.simulation.robot import Robot
from worker.simulation.robot_identity import identity
from worker.simulation.robot_view import RobotView
from worker.simulation.worlds import Worlds

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
    existing, here = both.free_of_contacts()
    for field in ("nq", "nv", "nu", "na", "ntendon", "neq"):
        assert getattr(here, field) == getattr(existing, field)
    assert here.body_mass.sum() == pytest.approx(existing.body_mass.sum(), rel=1e-6)
    first, second = both.columns()
    controls = np.full(existing.nu, 0.2)
    np.testing.assert_allclose(stepped(here, second, controls), stepped(existing, first, controls), atol=1e-4)


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


ENDS_OF = {
    "equality": [
        ('<connect body1="{}" anchor="0 0 0" active="false"/>', "b", "c", "body1"),
        ('<weld body1="c" body2="{}" active="false"/>', "b", "world", "body2"),
        ('<weld body1="c" anchor="{} 0 0" active="false"/>', "0", ".1", "anchor2"),
        ('<weld body1="c" relpose="0 0 0 1 {} 0 0" active="false"/>', "0", ".1", "turn"),
        ('<weld body1="c" torquescale="{}" active="false"/>', "1", "2", "torquescale"),
        ('<joint joint1="{}" active="false"/>', "j", "k", "joint1"),
        ('<joint joint1="j" joint2="k" polycoef="0 {}" active="false"/>', "1", "2", "polycoef"),
        ('<tendon tendon1="{}" active="false"/>', "e", "f", "tendon1"),
    ],
    "actuator": [
        ('<motor joint="{}"/>', "j", "k", "joint"),
        ('<motor tendon="{}"/>', "e", "f", "tendon"),
        ('<motor site="{}"/>', "s", "t", "site"),
        ('<motor site="s" refsite="{}"/>', "s", "t", "refsite"),
        ('<motor cranksite="{}" slidersite="t" cranklength="1"/>', "s", "t", "cranksite"),
        ('<adhesion body="{}" ctrlrange="0 1"/>', "b", "c", "body"),
    ],
    "tendon": [
        ('<fixed name="tendon_2"><joint joint="{}" coef="1"/></fixed>', "j", "k", "path 0"),
        ('<fixed name="tendon_2"><joint joint="j" coef="{}"/></fixed>', "1", "2", "coefficients"),
        ('<spatial name="tendon_2"><site site="s"/><geom geom="{}"/><site site="t"/></spatial>', "g", "h", "path 1"),
        ('<spatial><site site="s"/><site site="{}"/></spatial>', "u", "t", "existence"),
    ],
    "pair": [('<pair geom1="{}" geom2="i"/>', "g", "h", "existence")],
}
"""Of each kind of element: one of it, two values of its blank, and the field in which the two robots differ."""
NUMBERED = {"equality": "equality equality_0", "actuator": "actuator actuator_0", "tendon": "tendon tendon_2"}


@pytest.mark.parametrize(("kind", "row"), [(kind, row) for kind, rows in ENDS_OF.items() for row in rows])
def test_an_end_on_another_element_is_found(kind: str, row: tuple[str, str, str, str]) -> None:
    element, here, existing, field = row
    built, file = (read(ends(**{kind: element.format(value)})) for value in (here, existing))
    assert file.reference is not None
    found = [
        f"{each.element}: {each.field}" for each in robot_judge.compare(file.reference.model, built.builder).differences
    ]
    assert f"{NUMBERED.get(kind, 'contact pair 0')}: {field}" in found


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
    builder = template(robot)
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


def test_a_keyframe_does_not_forbid_another_root() -> None:
    posed = mjcf(f"<freejoint/>{BOX}{SECOND.replace('k', 'j')}", '<keyframe><key qpos="0 0 1 1 0 0 0 .3"/></keyframe>')
    assert read(posed, fixed=True).reference is not None


@pytest.mark.parametrize("named", [True, False])
def test_the_integrator_is_the_file_s_where_it_names_one(named: bool) -> None:
    option = '<option integrator="Euler"/>' if named else ""
    for body in (HINGE, '<joint name="j" axis="0 1 0" springdamper=".1 1"/>'):  # read as it is, and rewritten
        values: Any = read(mjcf(body + BOX, before=option)).builder.custom_attributes["mujoco:integrator"].values
        assert (values or {}).get(0) == (0 if named else None)


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
    assert RobotView(template(Robot(limited, joint_positions={"j": 3.0}))).beyond_limits() == [
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


def test_joints_that_count_from_a_reference_are_noted() -> None:
    shifted = mjcf('<joint name="j" axis="0 1 0" ref="30" range="0 60"/>' + BOX)
    assert read(shifted).notes == (
        "positions and limits of joints count from their ref in the file, which is 0 here (joint j: 0.523599)",
    )
    assert read(mjcf(HINGE + BOX)).notes == ()
