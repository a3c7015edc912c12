"""``muster robot``: a robot's file as a task would load it, and what Newton's importer reads otherwise."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

MUSTER = str(Path(sys.executable).parent / "muster")
CHEETAH = """<mujoco><compiler settotalmass="14"/><worldbody><geom name="floor" type="plane" size="5 5 1"/>
<body name="torso" pos="0 0 .7"><joint name="x" type="slide" axis="1 0 0"/><joint name="turn" axis="0 1 0" pos="0 0 .1" range="-60 60"/>
<geom type="capsule" fromto="-.5 0 0 .5 0 0" size=".05"/></body></worldbody>
<actuator><motor name="motor" joint="turn" gear="120" ctrlrange="-1 1"/></actuator><sensor><gyro name="spin" site="s"/></sensor></mujoco>"""


def command(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    (folder / "cheetah.xml").write_text(CHEETAH.replace("<geom type", '<site name="s"/><geom type'))
    (folder / "late.xml").write_text(
        CHEETAH.replace("ctrlrange", 'nsample="4" delay=".01" ctrlrange').replace('site="s"', 'site="t"')
    )
    return subprocess.run([MUSTER, "robot", *arguments], cwd=folder, capture_output=True, text=True, check=False)


def test_it_describes_a_robot_and_draws_it(tmp_path: Path) -> None:
    found = command(tmp_path, "cheetah.xml", "-o", "cheetah.png", "--json")
    assert found.returncode == 0, found.stderr
    shown = json.loads(found.stdout)
    assert shown["mass"] == 14.0 and [body["name"] for body in shown["bodies"]] == ["torso"]
    slide, hinge = shown["joints"]
    assert (slide["name"], slide["kind"], slide["lower"]) == ("x", "slide", None)
    assert (hinge["name"], hinge["kind"], round(hinge["upper"], 4)) == ("turn", "hinge", 1.0472)
    assert shown["actuators"][0]["drives"] == "joint turn" and shown["actuators"][0]["gear"] == 120.0
    assert shown["sensors"] == [{"name": "spin", "kind": "gyro"}]
    assert {each["field"] for each in shown["corrected"]} >= {"mass", "pos"}
    assert (tmp_path / "cheetah.png").read_bytes().startswith(b"\x89PNG") and shown["picture"] == "cheetah.png"
    again = command(tmp_path, "cheetah.xml", "-o", "cheetah.png")
    assert again.returncode == 2 and "cheetah.png" in again.stderr and "--overwrite" in again.stderr


def test_it_lists_what_newton_reads_otherwise(tmp_path: Path) -> None:
    found = command(tmp_path, "cheetah.xml", "--compare")
    assert found.returncode == 0 and "JOINTS" in found.stdout and "MASS [kg]" in found.stdout
    assert "body torso  mass" in found.stdout and "14" in found.stdout and not (tmp_path / "cheetah.png").exists()


def test_it_lists_what_can_t_be_held(tmp_path: Path) -> None:
    found = command(tmp_path, "late.xml", "--compare")
    assert found.returncode == 2 and "actuator motor  delay" in found.stdout
    assert found.stderr.startswith(
        "muster: late.xml would be another robot here: actuator motor: delay is 0, in the file 0.01"
    )
    assert found.stderr.count("\n") == 1


MUSCLES = """<mujoco><worldbody><body name="b"><joint name="k"/><geom size=".1"/><site name="s"/><body pos="0 0 1">
<joint name="j" type="ball" damping=".2"/><geom size=".1"/><site name="t"/></body></body></worldbody><tendon><spatial name="rope" range="0 3">
<site site="s"/><site site="t"/></spatial></tendon><equality><joint name="held" joint1="k" active="false"/></equality><actuator>
<damper name="brake" joint="k" kv="2" ctrlrange="0 1"/><muscle name="muscle" tendon="rope" force="100" lengthrange="0 2"/></actuator></mujoco>"""


def test_it_shows_tendons_equalities_balls_and_only_the_numbers_that_an_actuator_has(tmp_path: Path) -> None:
    (tmp_path / "muscles.xml").write_text(MUSCLES)
    shown = json.loads(command(tmp_path, "muscles.xml", "--json").stdout)
    hinge, ball = shown["joints"]
    assert hinge["effort_limit"] is None and (ball["name"], ball["kind"], ball["damping"]) == ("j", "ball", 0.2)
    brake, muscle = shown["actuators"]
    assert (brake["gain"], brake["stiffness"], brake["damping"], brake["law"]) == (0.0, 0.0, 2.0, "affine")
    assert (muscle["gain"], muscle["stiffness"], muscle["damping"], muscle["law"]) == (None, None, None, "muscle")
    (rope,), (held,) = shown["tendons"], shown["equalities"]
    assert (rope["connects"], rope["lower"], rope["upper"]) == (["site s", "site t"], 0.0, 3.0)
    assert (held["name"], held["kind"], held["connects"], held["active"]) == ("held", "joint", ["joint k"], False)
    text = command(tmp_path, "muscles.xml").stdout
    assert "rope" in text and "joint, off" in text and "2 joints" in text


USD = """#usda 1.0
(
    metersPerUnit = 1
    upAxis = "Z"
)
def Xform "robot" (prepend apiSchemas = ["PhysicsArticulationRootAPI"]) {
    def Cube "base" (prepend apiSchemas = ["PhysicsRigidBodyAPI", "PhysicsMassAPI", "PhysicsCollisionAPI"]) {
        double size = 0.2
        float physics:mass = 2
    }
    def Cube "arm" (prepend apiSchemas = ["PhysicsRigidBodyAPI", "PhysicsMassAPI", "PhysicsCollisionAPI"]) {
        double size = 0.2
        float physics:mass = 3
        double3 xformOp:translate = (0.5, 0, 0)
        uniform token[] xformOpOrder = ["xformOp:translate"]
    }
    def Cube "table" (prepend apiSchemas = ["PhysicsRigidBodyAPI"]) {
    }
    def PhysicsRevoluteJoint "j" (prepend apiSchemas = ["PhysicsDriveAPI:angular"]) {
        rel physics:body0 = </robot/base>
        rel physics:body1 = </robot/arm>
        point3f physics:localPos0 = (0.5, 0, 0)
        uniform token drive:angular:physics:type = "acceleration"
        float drive:angular:physics:stiffness = 10
        float drive:angular:physics:damping = 1
        float drive:angular:physics:maxForce = 7
    }
}
"""


def test_it_shows_drives_of_a_usd_file_as_its_task_would_have_them(tmp_path: Path) -> None:
    (tmp_path / "arm.usda").write_text(USD)
    refused = command(tmp_path, "arm.usda", "--ignore", "table", "--compare")
    assert (
        refused.returncode == 2 and refused.stderr.count("\n") == 1 and "drive /robot/j.angular  type" in refused.stdout
    )
    assert "accept=('drive /robot/j.angular: type',)" in refused.stderr
    taken = ("arm.usda", "--ignore", "table", "--accept", "drive *: type", "--fixed")
    found = json.loads(command(tmp_path, *taken, "--json").stdout)
    assert found["fixed"] and [body["name"] for body in found["bodies"]] == ["base", "arm"]
    (drive,) = found["actuators"]
    assert (drive["name"], drive["drives"], drive["force_range"]) == ("j", "joint j", [-7.0, 7.0])
    assert (round(drive["stiffness"], 3), round(drive["damping"], 3)) == (572.958, 57.296)
    shown = command(tmp_path, *taken).stdout
    assert "ACTUATORS" in shown and "-7 to 7" in shown and "no free root" in shown


def test_a_file_of_bytes_is_refused_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "bytes.usda").write_bytes(bytes(range(256)))
    refused = command(tmp_path, "bytes.usda")
    assert refused.returncode == 2 and refused.stdout == ""
    assert refused.stderr.startswith("muster: bytes.usda can't be read: ") and "pxrInternal" not in refused.stderr
