"""What is wrong with a robot, its file or the solver's options is reported in one line, with what exists."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import newton
import pytest
import torch
import warp as wp

from tests.support.refusals import refusal
from tests.support.worker.robot_texts import template
from worker.simulation.actuators import (
    DCMotorActuator,
    EffortActuator,
    ExplicitPDActuator,
    PositionActuator,
    VelocityActuator,
)
from worker.simulation.collisions import Collision
from worker.simulation.objects import Box, Capsule, Sphere
from worker.simulation.robot import Robot
from worker.simulation.robot_elements import empty_builder
from worker.simulation.robot_view import RobotView
from worker.simulation.worlds import Worlds

SERVO = PositionActuator("*", 60.0, 3.0)
LEG = """<mujoco model="leg">{assets}<worldbody><body name="thigh" pos="0 0 1"><joint name="left_hip" range="-60 60"/>
  <geom name="thigh_collision" size=".1"/><site name="knee_mark"/>
  <body name="shank" pos="0 0 -.3"><joint name="left_knee"/><geom name="shank_collision" size=".1"/>{geoms}</body></body>
</worldbody>{actuators}</mujoco>"""


def leg(assets: str = "", geoms: str = "", actuators: str = "") -> str:
    return LEG.format(assets=assets, geoms=geoms, actuators=actuators)


def build(*items: Any) -> Callable[[], Any]:
    return lambda: template(*items)


def robot(*actuators: Any, **options: Any) -> Callable[[], Any]:
    """The leg's world, with servos where no actuators are given."""
    return lambda: template(Robot(leg(), **{"actuators": actuators or (SERVO,), **options}))


def view(use: Callable[[RobotView], Any], actuators: Any = (SERVO,)) -> Callable[[], Any]:
    return lambda: use(RobotView(template(Robot(leg(), actuators=actuators))))


def walker() -> newton.ModelBuilder:
    return template(Robot(leg(), name="walker", actuators=(SERVO,)), Box("cube"))


MISTYPED, EXPRESSION = PositionActuator("left_kne", 1.0, 1.0), PositionActuator(".*_knee", 1.0, 1.0)
KNEES, HIPS = PositionActuator("*_knee", 1.0, 0.1), PositionActuator("*", {"*_hip": 5.0}, 1.0)
ASSETS = "package:newton/examples"
CASES: dict[str, Callable[[], Any]] = {
    "its XML has no actuators ... PositionActuator ... joints: left_hip, left_knee": robot(actuators=()),
    "PositionActuator('left_kne'): no joint of robot matches 'left_kne'; did you mean left_knee? "
    "available: left_hip, left_knee": robot(MISTYPED),
    "not regular expressions ... did you mean '*_knee'?": robot(EXPRESSION),
    "no pattern for a joint of robot was given": robot(PositionActuator((), 1.0, 1.0)),
    "robot: two actuators drive the joint left_knee ... PositionActuator('*') ... ('*_knee')": robot(SERVO, KNEES),
    "no pattern of stiffness matches the joint left_knee ... add '*'": robot(HIPS),
    "PositionActuator('*'): stiffness must be 0 or more": lambda: PositionActuator("*", -1.0, 0.0),
    "effort_limit must be greater than 0": lambda: EffortActuator("*", effort_limit=0.0),
    "velocity_limit must be greater than 0, not 0.0": lambda: DCMotorActuator(
        "*", 1.0, 1.0, saturation_effort=1.0, velocity_limit=0.0
    ),
    "damping must be 0 or more, not 'high'": lambda: VelocityActuator("*", "high"),
    "delay is a whole number ... 0.5": lambda: ExplicitPDActuator("*", 1.0, 1.0, delay=0.5),
    "robot: joint_positions: no joint of robot matches 'right_*'": robot(joint_positions={"right_*": 1.0}),
    "robot: armature: no joint of robot matches '*_toe'": robot(armature={"*_toe": 1.0}),
    "no geom of robot matches 'foot_collision' ... thigh_collision, shank_collision": robot(
        collisions=(Collision("foot_collision"),)
    ),
    "no pattern of condim ... shank_collision ... add '*'": robot(collisions=(Collision("*", condim={"thigh*": 3}),)),
    "condim is 1, 3, 4 or 6, not 2": lambda: Collision("*", condim=2),
    "contype is a whole number from 0 ... -1": lambda: Collision("*", contype=-1),
    "two things in the world are called 'cube'": build(Box("cube"), Sphere("cube")),
    "a word without slashes, not 'a/b'": lambda: template(Box("a/b")),
    "the world has no robot or object 'walkr' ... did you mean walker?": lambda: RobotView(walker(), "walkr"),
    "no body of robot matches 'shin' ... thigh, shank": view(lambda robot: robot.find_bodies("shin")),
    "no site of robot matches 'foot' ... knee_mark": view(lambda robot: robot.find_sites("foot")),
    "no geom of robot matches 'x*'": view(lambda robot: robot.find_geoms("x*")),
    "it needs limits of its position, which joint left_knee of robot lacks": view(
        lambda robot: robot.need_ranges([0, 1], "it")
    ),
    "it needs a limit of its force ... left_hip ... effort_limit": view(lambda robot: robot.need_efforts([0], "it")),
    "it needs an actuator, which joint left_hip ... left_knee": view(
        lambda robot: robot.need_efforts([0, 1], "it"), (KNEES,)
    ),
    "Box 'cube': mass must be greater than 0": lambda: Box("cube", mass=0.0),
    "Box 'cube': size must be greater than 0": lambda: Box("cube", size=(1.0, 1.0, 0.0)),
    "Capsule 'rod': radius must be greater than 0": lambda: Capsule("rod", radius=-1.0),
    "Sphere 'ball': friction must be 0 or more": lambda: Sphere("ball", friction=-1.0),
    "the robot's XML: is not XML": lambda: template(Robot("<mujoco><worldbody>")),
    "unrecognized element ... worldbodyy": lambda: template(Robot("<mujoco><worldbodyy/></mujoco>")),
    "first element is <sdf> ... <mujoco> ... <robot>": lambda: template(Robot("<sdf/>")),
    "has no body that could be a robot's": lambda: template(Robot("<mujoco/>")),
    "no Python package 'newtonn' ... did you mean newton?": lambda: template(Robot("package:newtonn/a.xml")),
    "no such file in Newton's assets ... did you mean nv_ant.xml?": lambda: template(Robot("newton:nv_antt.xml")),
    "no such file in the package newton ... did you mean quadruped.urdf?": lambda: template(
        Robot(f"{ASSETS}/assets/quadrupd.urdf")
    ),
    "no folder 'asset' in the package newton ... did you mean examples/assets/quadruped.urdf?": lambda: template(
        Robot(f"{ASSETS}/asset/quadruped.urdf")
    ),
}


@pytest.mark.parametrize("parts", CASES)
def test_a_mistake_is_reported_in_one_line(parts: str) -> None:
    output = refusal(CASES[parts])
    assert all(part in output for part in parts.split(" ... ")), output


@pytest.mark.parametrize(
    ("name", "parts"),
    [
        ("legg.xml", "there is no such file in ... did you mean leg.xml?"),
        ("leg.stl", "a robot's file ends in .xml, .mjcf, .urdf ... not in '.stl'"),
        ("", "is a folder; name a robot's file in it (leg.xml)"),
        ("nowhere/leg.xml", "there is no folder ... nowhere ... relative paths begin at"),
    ],
)
def test_a_file_that_is_not_there_is_refused_with_the_nearest(tmp_path: Path, name: str, parts: str) -> None:
    (tmp_path / "leg.xml").write_text(leg())
    (tmp_path / "leg.stl").write_text("")
    output = refusal(lambda: template(Robot(tmp_path / name if name else tmp_path)))
    assert all(part in output for part in parts.split(" ... ")), output


@pytest.mark.parametrize(
    ("mesh", "words"),
    [
        ("meshes/base.obj", r"its mesh meshes/base\.obj is missing in .*meshes; did you mean bases\.obj\?"),
        ("package://arm/meshes/base.obj", r"its mesh package://arm/meshes/base\.obj is missing .*mean bases\.obj\?"),
        ("package://leg/meshes/bases.obj", r"is of the package leg, but no folder above the file has that name"),
    ],
)
def test_a_missing_mesh_of_a_urdf_file(tmp_path: Path, mesh: str, words: str):
    urdf = f'<robot name="arm"><link name="base"><visual><geometry><mesh filename="{mesh}"/></geometry></visual></link></robot>'
    folder = tmp_path / "arm"
    (folder / "meshes").mkdir(parents=True)
    (folder / "meshes" / "bases.obj").write_text("")
    (folder / "arm.urdf").write_text(urdf)
    with pytest.raises(ValueError, match=r"arm\.urdf: .*" + words):
        template(Robot(folder / "arm.urdf", actuators=(SERVO,)))
    with pytest.raises(ValueError, match="relative to a URDF file; give the path of that file"):
        template(Robot(urdf, actuators=(SERVO,)))


# A tetrahedron with legs of 1 m: its volume is 1/6 m^3.
TETRAHEDRON = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


def test_meshes_are_read(tmp_path: Path):
    """URDF in a package, and MJCF in the folder that it names; the mass is the density's times the volume by hand."""
    (tmp_path / "arm" / "meshes").mkdir(parents=True)
    (tmp_path / "arm" / "meshes" / "base.obj").write_text(TETRAHEDRON)
    (tmp_path / "arm" / "arm.urdf").write_text(
        '<robot name="arm"><link name="base"><collision><geometry><mesh filename="package://arm/meshes/base.obj"/>'
        "</geometry></collision></link></robot>"
    )
    (tmp_path / "arm" / "arm.xml").write_text(
        '<mujoco><compiler meshdir="meshes"/><asset><mesh name="base" file="base.obj"/></asset><worldbody><body name="base"><freejoint/>'
        '<geom type="mesh" mesh="base" density="1000"/></body></worldbody></mujoco>'
    )
    for name in ("arm.urdf", "arm.xml"):
        builder = template(Robot(tmp_path / "arm" / name, fixed=False))
        assert builder.body_mass[0] == pytest.approx(1000 / 6, rel=1e-4), name


def test_a_robot_may_be_declared_passive():
    door = Robot(leg(), name="door", passive=True)
    assert RobotView(template(door), "door").actuators == [-1, -1]


MJCF = """<mujoco><worldbody><body pos="0 0 1">
  <joint name="hinge" type="hinge" axis="0 1 0"/>
  <geom type="capsule" fromto="0 0 0 0 0 -0.5" size="0.03" mass="0.5" contype="0" conaffinity="0"/>
  <body pos="0 0 -0.5"><joint name="knee" type="hinge" axis="0 1 0"/>
    <geom type="capsule" fromto="0 0 0 0 0 -0.5" size="0.03" mass="0.5" contype="0" conaffinity="0"/></body>
</body></worldbody><actuator>{}</actuator></mujoco>"""
URDF = """<robot name="arm"><link name="base"/><link name="tip"><inertial><mass value="1"/>
  <inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="elbow" type="revolute"><parent link="base"/><child link="tip"/><axis xyz="0 1 0"/>
  <limit lower="-1" upper="1" effort="5" velocity="2"/></joint></robot>"""
SERVOS = '<position name="servo" joint="hinge" kp="30" kv="3"/><velocity joint="knee" kv="1"/>'
MIXED = '<motor joint="knee"/><position joint="hinge"/>'


def worlds_of(add: Callable[[newton.ModelBuilder], Any], **options: Any) -> Worlds:
    """Two worlds of what is added to an empty builder."""
    builder = empty_builder()
    add(builder)
    solver = {"disable_contacts": True, "njmax": 4, "nconmax": 0, **options}
    return Worlds(builder, 2, "cpu", timestep=1 / 120, substeps=2, fastest=1e3, ground=False, solver_options=solver)


def mjcf(actuators: str, **options: Any) -> Callable[[newton.ModelBuilder], Any]:
    return lambda builder: builder.add_mjcf(MJCF.format(actuators), **options)


@pytest.mark.parametrize(
    ("add", "parts"),
    [
        (mjcf(SERVOS), ["actuators of joints hinge, knee would ignore", "ctrl_direct=True"]),
        (mjcf(MIXED), ["actuators of joint hinge would", "ctrl_direct=True"]),
        (lambda builder: builder.add_urdf(URDF), ["nothing would drive the robot: joint elbow follow", "in MJCF"]),
        (mjcf(""), ["the robot has no actuators", "<actuator>"]),
    ],
)
def test_a_robot_that_no_action_would_move_is_refused(
    add: Callable[[newton.ModelBuilder], Any], parts: list[str]
) -> None:
    output = refusal(worlds_of, add)
    assert "\n" not in output and all(part in output for part in parts), output


def test_the_same_servos_added_as_the_refusal_says_follow_their_controls() -> None:
    worlds = worlds_of(mjcf(SERVOS, ctrl_direct=True))
    controls, angles = wp.to_torch(worlds.arrays.controls), wp.to_torch(worlds.arrays.joint_q)
    controls.copy_(torch.tensor([[0.3, 0.0], [-0.3, 0.0]]))
    for _ in range(120):
        worlds.simulate()
    assert angles[0, 0] > 0.2 and angles[1, 0] < -0.2


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"disable_sensors": False}, "disable_sensors is always True here; leave it out"),
        ({"separate_worlds": True}, "separate_worlds is always True here; leave it out"),
        ({"iteration": 4}, "SolverMuJoCo has no option 'iteration'; did you mean iterations?"),
        ({"model": None}, "SolverMuJoCo has no option 'model'; "),
    ],
)
def test_an_option_of_the_solver_that_is_not_a_task_s_is_refused(options: dict[str, Any], message: str) -> None:
    output = refusal(worlds_of, mjcf('<motor joint="hinge"/>'), **options)
    assert output.startswith("solver_options: ") and message in output and "\n" not in output


def test_no_other_exception_than_a_value_error_escapes() -> None:
    with pytest.raises(ValueError, match=r"robot: a+\.xml can't be read: OSError: .*File name too long"):
        Robot(f"{'a' * 300}.xml").read()


def test_a_load_prints_none_of_newton_s_warnings_of_what_is_judged_here(
    caplog: pytest.LogCaptureFixture, capfd: pytest.CaptureFixture[str]
) -> None:
    """Newton warns of solvers that are not used here."""
    weld = '<equality><weld body1="thigh" body2="shank" torquescale="0.5"/></equality>'
    Robot(leg(actuators=weld)).read()
    assert [record for record in caplog.records if record.name.startswith("newton")] == []
    assert "torquescale" not in capfd.readouterr().err
