"""A robot of a USD file is what USD's schema says: values are corrected or refused by the path of their prim."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import newton
import numpy as np
import pytest

from tests.support.worker.robot_texts import template
from worker.settings.accepted_changes import CHANGED_ROBOTS
from worker.simulation.robot import Robot
from worker.simulation.robot_reading import Reading
from worker.simulation.robot_view import RobotView
from worker.simulation.worlds import Worlds

USD = """#usda 1.0
(
    metersPerUnit = 1
    upAxis = "Z"
)
def Xform "robot" (
    prepend apiSchemas = ["PhysicsArticulationRootAPI", "MaterialBindingAPI"]
)
{
    {{robot}}
    def Cube "base" (
        prepend apiSchemas = ["PhysicsRigidBodyAPI", "PhysicsMassAPI", "PhysicsCollisionAPI"]
    ) {
        double size = 0.2
        float physics:mass = 2
        {{base}}
    }
    def Cube "arm" (
        prepend apiSchemas = ["PhysicsRigidBodyAPI", "PhysicsMassAPI", "PhysicsCollisionAPI"]
    ) {
        double size = 0.2
        float physics:mass = 3
        double3 xformOp:translate = (0.5, 0, 0)
        double xformOp:rotateY = 0
        uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateY"]
        {{arm}}
    }
    def PhysicsRevoluteJoint "j" (
        prepend apiSchemas = ["PhysicsDriveAPI:angular"]
    ) {
        rel physics:body0 = </robot/base>
        rel physics:body1 = </robot/arm>
        uniform token physics:axis = "Y"
        point3f physics:localPos0 = (0.5, 0, 0)
        float physics:lowerLimit = -30
        float physics:upperLimit = 60
        {{joint}}
    }
}
"""
DRIVE = """float drive:angular:physics:stiffness = 10
float drive:angular:physics:damping = 1
float drive:angular:physics:maxForce = 7
float drive:angular:physics:targetPosition = 45
"""
RUBBER = """rel material:binding = </robot/rubber>
def Material "rubber" (prepend apiSchemas = ["PhysicsMaterialAPI"]) {
    float physics:dynamicFriction = 0.4
    float physics:staticFriction = 0.6
    float physics:restitution = 0.5
}"""


def usd(folder: Path, replaced: dict[str, str] | None = None, **more: str) -> str:
    """A file of two bodies and a hinge, with more lines in its prims and words replaced."""
    text = USD
    for place in ("robot", "base", "arm", "joint"):
        text = text.replace("{{" + place + "}}", more.get(place, ""))
    for before, after in (replaced or {}).items():
        assert before in text, before
        text = text.replace(before, after)
    path = folder / "robot.usda"
    path.write_text(text)
    return str(path)


def read(file: str, **options: Any) -> Reading:
    return Robot(file, passive=True, **options).read()


def stepped(scene: newton.ModelBuilder) -> Worlds:
    """One world without a ground, of 50 control steps a second."""
    options = {"disable_contacts": True}
    return Worlds(scene, 1, "cpu", timestep=0.002, substeps=10, fastest=False, ground=False, solver_options=options)


def corrected(reading: Reading) -> list[str]:
    return [str(each) for each in reading.corrected]


def test_what_the_schema_says_is_left_alone(tmp_path: Path) -> None:
    reading = read(usd(tmp_path))
    assert reading.identity.mass == 5.0 and reading.reference is None
    assert (reading.corrected, reading.notes, reading.identity.actuators) == ((), (), 0)


@pytest.mark.parametrize(
    ("replaced", "more", "words"),
    [
        ({"metersPerUnit = 1": "metersPerUnit = 0.01"}, {}, r"metersPerUnit is 0.01; export the file in metres"),
        ({"float physics:mass = 3": "", '"PhysicsCollisionAPI"': ""}, {}, r"body /robot/arm moves and has no mass"),
        ({"mass = 3": "mass = -3"}, {}, r"body /robot/arm: its mass is -3, which no body has"),
        ({}, {"arm": "float3 physics:diagonalInertia = (1, 2, 10)"}, r"body /robot/arm: its moments of inertia 1 2 10"),
        ({"upperLimit = 60": "upperLimit = nan"}, {}, r"joint /robot/j: its limits -30 and nan are not a range"),
        ({"upperLimit = 60": "upperLimit = -40"}, {}, r"joint /robot/j: its limits -30 and -40 are not a range"),
        (
            {"def PhysicsRevoluteJoint": "def PhysicsJoint"},
            {},
            r"joint /robot/j has 0 degrees of freedom, in the file 6",
        ),
        ({"body1 = </robot/arm>": "body1 = </robot/arn>"}, {}, r"joint /robot/j holds /robot/arn, .*; did you mean /robot/arm"),
        ({}, {"arm": "bool physics:rigidBodyEnabled = 0"}, r"joint /robot/j holds the body /robot/arm, which is disab"),
        ({}, {"arm": "bool physics:kinematicEnabled = 1"}, r"/robot/arm'\) is kinematic .* Only root bodies"),
        (
            {},
            {"robot": 'def PhysicsRevoluteJoint "k" {\nrel physics:body0 = </robot/base>\nrel physics:body1 = </robot/arm>\n}'},
            r"joints /robot/[jk] and /robot/[jk] stand between the same bodies",
        ),
        (
            {"(0.5, 0, 0)\n        double xform": "(0.5, 0.1, 0)\n        double xform"},
            {},
            r"body /robot/arm: place is \(0.5 0 0 0 0 0 1\), in the file \(0.5 0.1 0 0 0 0 1\).*accept=\('body /robot/arm: place',",
        ),
        (
            {},
            {"joint": DRIVE + 'uniform token drive:angular:physics:type = "acceleration"'},
            r"drive /robot/j.angular: type is force, in the file acceleration",
        ),
        (
            {},
            {"joint": DRIVE + "float drive:angular:physics:targetVelocity = 90"},
            r"drive /robot/j.angular: targetVelocity is 0, in the file 1.5708",
        ),
    ],
)  # fmt: skip
def test_what_can_t_be_held_is_refused_by_its_path(
    tmp_path: Path, replaced: dict[str, str], more: dict[str, str], words: str
) -> None:
    with pytest.raises(ValueError, match=words) as refused:
        read(usd(tmp_path, replaced, **more))
    assert "\n" not in str(refused.value)


def test_a_difference_can_be_accepted(tmp_path: Path) -> None:
    file = usd(tmp_path, joint=DRIVE + 'uniform token drive:angular:physics:type = "acceleration"')
    assert read(file, accept=("drive *: type",)).identity.actuators == 1
    token = CHANGED_ROBOTS.set(True)
    try:
        assert "drive /robot/j.angular: type is force" in read(file).notes[0]
    finally:
        CHANGED_ROBOTS.reset(token)


def test_joints_begin_where_the_file_places_its_bodies(tmp_path: Path) -> None:
    reading = read(usd(tmp_path, {"rotateY = 0": "rotateY = 40"}))
    assert RobotView(reading.builder, "").defaults == pytest.approx([math.radians(40.0)])
    assert corrected(reading) == ["joint /robot/j: position is 0, in the file 0.698132"]
    assert reading.lines()[0].startswith("built as USD's schema reads its file; Newton's importer differs in 1 value")
    state = "float state:angular:physics:position = 20"
    (tmp_path / "state").mkdir()
    supplied = read(usd(tmp_path / "state", joint=state))
    assert RobotView(supplied.builder, "").defaults == pytest.approx([math.radians(20.0)]) and not supplied.corrected


def test_a_joint_from_a_body_to_the_world_turns_the_way_the_file_says(tmp_path: Path) -> None:
    """Its first body moves, so that the same angle turns it the other way about the axis."""
    joint = 'def PhysicsRevoluteJoint "w" {\nrel physics:body0 = </robot/base>\nuniform token physics:axis = "X"\n}'
    reading = read(usd(tmp_path, robot=joint))
    assert corrected(reading) == ["joint /robot/w: physics:axis is (1 0 0), in the file (-1 0 0)"]
    assert [*reading.builder.joint_axis[0]] == [-1.0, 0.0, 0.0]


def test_frames_masses_and_inertias_are_those_of_the_schema_in_scaled_and_turned_prims(tmp_path: Path) -> None:
    arm = """float3 xformOp:scale = (2, 2, 2)
    point3f physics:centerOfMass = (0.1, 0.2, 0.3)
    float3 physics:diagonalInertia = (1, 2, 2.5)
    quatf physics:principalAxes = (0.70710678, 0, 0, 0.70710678)"""
    changed = {
        '"xformOp:rotateY"]': '"xformOp:rotateY", "xformOp:scale"]',
        'upAxis = "Z"': 'upAxis = "Y"',
        "(0.5, 0, 0)\n        double": "(0.3, 0, 0)\n        double",
    }
    reading = read(usd(tmp_path, changed, arm=arm, joint="point3f physics:localPos1 = (0.1, 0, 0)"))
    builder = reading.builder
    np.testing.assert_allclose([*builder.body_com[1]], [0.2, 0.4, 0.6], rtol=1e-5)
    np.testing.assert_allclose(np.array(builder.body_inertia[1]).reshape(3, 3), np.diag([2.0, 1.0, 2.5]), atol=1e-5)
    np.testing.assert_allclose([*builder.joint_X_c[1]][:3], [0.2, 0.0, 0.0], atol=1e-6)
    assert reading.corrected == ()


def test_values_of_the_importer_that_differ_are_corrected(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each value is spoilt behind the importer's back."""
    add = newton.ModelBuilder.add_usd

    def spoilt(self: newton.ModelBuilder, *supplied: Any, **options: Any) -> Any:
        found = add(self, *supplied, **options)
        self.body_mass[1], self.body_com[1] = 9.0, self.body_com[1] + type(self.body_com[1])(0.1, 0.0, 0.0)
        self.body_inertia[1] = self.body_inertia[1] * 2.0
        self.joint_limit_lower[6], self.joint_armature[6], self.joint_friction[6], self.joint_damping[6] = 1, 2, 3, 4
        self.joint_X_p[1] = type(self.joint_X_p[1])(0.0, 0.0, 0.1, 0.0, 0.0, 0.0, 1.0)
        self.joint_effort_limit[6] = 70.0
        return found

    monkeypatch.setattr(newton.ModelBuilder, "add_usd", spoilt)
    arm = "point3f physics:centerOfMass = (0, 0, 0)\nfloat3 physics:diagonalInertia = (1, 1, 1)"
    joint = DRIVE + "float newton:armature = 0.1\nfloat newton:friction = 0.2\nfloat newton:damping = 0.3"
    reading = read(usd(tmp_path, arm=arm, joint=joint))
    assert {f"{each.element} {each.field}" for each in reading.corrected} == {
        *(f"body /robot/arm physics:{name}" for name in ("mass", "centerOfMass", "diagonalInertia")),
        *(f"joint /robot/j {name}" for name in ("physics:lowerLimit", "armature", "friction", "damping")),
        "joint /robot/j physics:localPos0 and localRot0",
        "drive /robot/j.angular maxForce",
    }
    builder = reading.builder
    assert (builder.body_mass[1], builder.joint_armature[6], builder.joint_effort_limit[6]) == pytest.approx(
        (3, 0.1, 7)
    )
    assert builder.joint_damping[6] == pytest.approx(math.degrees(0.3))
    np.testing.assert_allclose([*builder.joint_X_p[1]], [0.5, 0, 0, 0, 0, 0, 1], atol=1e-6)


@pytest.mark.parametrize(
    ("lines", "values"),
    [
        ("float physxJoint:armature = 0.3", (0.3, 0.0, 0.0)),
        ("double mjc:armature = 0.4\ndouble mjc:frictionloss = 0.2\ndouble mjc:damping = 0.7", (0.4, 0.2, 0.7)),
    ],
    ids=["PhysX", "MuJoCo"],
)
def test_rotors_and_friction_of_other_schemas_are_read(tmp_path: Path, lines: str, values: tuple[float, ...]) -> None:
    builder = read(usd(tmp_path, joint=lines)).builder
    assert (builder.joint_armature[6], builder.joint_friction[6], builder.joint_damping[6]) == pytest.approx(values)


def test_a_friction_that_is_a_coefficient_is_noted(tmp_path: Path) -> None:
    note = read(usd(tmp_path, joint="float physxJoint:jointFriction = 0.2")).notes[0]
    assert note.startswith("joint /robot/j: PhysX's coefficient of friction 0.2 is not held")


def test_friction_comes_from_a_material_above_and_what_contacts_lack_is_noted(tmp_path: Path) -> None:
    reading = read(usd(tmp_path, robot=RUBBER))
    assert reading.builder.shape_material_mu == pytest.approx([0.4, 0.4])
    assert "collider /robot/arm: physics:dynamicFriction is 1, in the file 0.4" in corrected(reading)
    still, bounce = reading.notes
    assert still == "material /robot/rubber: its static friction 0.6 is not held; contacts have one friction, 0.4"
    assert bounce.startswith("material /robot/rubber: its restitution 0.5 is not held")


def test_switches_of_the_schema_are_held(tmp_path: Path) -> None:
    folders = iter(range(9))

    def made(**more: str) -> Reading:
        folder = tmp_path / str(next(folders))
        folder.mkdir()
        return read(usd(folder, **more))

    collide = int(newton.ShapeFlags.COLLIDE_SHAPES)
    flags = dict(zip(*_flags(made(arm="bool physics:collisionEnabled = 0")), strict=True))
    assert flags["/robot/base"] & collide and not flags["/robot/arm"] & collide
    free = made(joint="bool physics:jointEnabled = 0").builder
    assert "/robot/j" not in free.joint_label and free.joint_type == [newton.JointType.FREE] * 2
    loop = made(joint="bool physics:excludeFromArticulation = 1")
    assert loop.notes[0].startswith("joint /robot/j closes a loop") and loop.builder.joint_articulation[-1] == -1
    assert "physics:collisionEnabled" in made(joint="bool physics:collisionEnabled = 1").notes[0]


def test_an_articulation_whose_bodies_do_not_collide_is_held(tmp_path: Path) -> None:
    touch = "bool physics:collisionEnabled = 1"
    assert read(usd(tmp_path, joint=touch)).builder.shape_collision_filter_pairs == []
    (tmp_path / "off").mkdir()
    off = usd(tmp_path / "off", robot="bool physxArticulation:enabledSelfCollisions = 0", joint=touch)
    assert read(off).builder.shape_collision_filter_pairs == [(0, 1)]


def _flags(reading: Reading) -> tuple[list[str], list[int]]:
    return reading.builder.shape_label, [int(flag) for flag in reading.builder.shape_flags]


def test_drives_become_actuators_whose_input_is_the_target(tmp_path: Path) -> None:
    scene = template(Robot(usd(tmp_path, joint=DRIVE), fixed=True))
    view = RobotView(scene)
    assert (view.actuators, view.inputs, view.efforts) == ([0], ["position"], [7.0])
    assert view.gains == pytest.approx([math.degrees(10.0)])
    worlds = stepped(scene)
    worlds.arrays.controls.fill_(0.5)
    for _ in range(100):
        worlds.simulate()
    held = worlds.arrays.joint_q.numpy()[0, view.coordinates[0]]
    assert held == pytest.approx(0.5, abs=0.01)


def test_a_kinematic_root_stays_where_it_is(tmp_path: Path) -> None:
    worlds = stepped(template(Robot(usd(tmp_path, base="bool physics:kinematicEnabled = 1", joint=DRIVE))))
    for _ in range(10):
        worlds.simulate()
    assert abs(worlds.arrays.joint_q.numpy()[0, :3]).max() < 1e-3
