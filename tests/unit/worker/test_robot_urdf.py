"""URDF files: joints that follow, and what is wrong, by the name of the link or the joint."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest

from tests.support.worker.robot_texts import read
from worker.simulation.robot import Robot
from worker.simulation.robot_twins import Twins

INERTIA = '<inertia ixx=".1" iyy=".1" izz=".1" ixy="0" ixz="0" iyz="0"/>'
LIMIT = '<limit lower="-1" upper="1" effort="1" velocity="1"/>'


def link(name: str, more: str = "", inertia: str = INERTIA) -> str:
    inertial = f'<inertial><origin xyz="0.1 0 0"/><mass value="1"/>{inertia}</inertial>'
    return f'<link name="{name}">{inertial}{more}</link>'


def joint(name: str, parent: str, child: str, more: str = "", *, kind: str = "revolute", limit: str = LIMIT) -> str:
    ends = f'<parent link="{parent}"/><child link="{child}"/><axis xyz="0 1 0"/>'
    return f'<joint name="{name}" type="{kind}">{ends}{limit}{more}</joint>'


def urdf(*parts: str) -> str:
    return f'<robot name="r" xmlns:xacro="http://www.ros.org/wiki/xacro">{"".join(parts)}</robot>'


def follower(mimic: str, kind: str = "revolute") -> str:
    links = link("a") + link("b") + link("c")
    return urdf(links, joint("i", "a", "b", kind=kind), joint("k", "a", "c", mimic))


def test_a_joint_that_mimics_has_one_equality_as_in_mujoco() -> None:
    text = follower('<mimic joint="i" multiplier="-2" offset=".1"/>')
    reading = read(text, fixed=True)
    assert reading.reference is not None
    own, built = mujoco.MjModel.from_xml_string(text), Twins(reading.reference.model, reading.builder).built
    assert own.neq == reading.reference.model.neq == built.neq == 1
    np.testing.assert_allclose(built.eq_data[0, :5], [0.1, -2.0, 0.0, 0.0, 0.0], rtol=1e-6)
    ends = [(model, mujoco.MjData(model)) for model in (own, built)]
    for model, data in ends:
        model.opt.timestep, model.opt.integrator = 1e-3, int(mujoco.mjtIntegrator.mjINT_IMPLICITFAST)
        mujoco.mj_step(model, data, 100)
    (_, theirs), (_, mine) = ends
    np.testing.assert_allclose(mine.qpos, theirs.qpos, rtol=1e-4)
    assert abs(theirs.qpos[0]) > 0.01 and abs(theirs.qpos[1] - (0.1 - 2.0 * theirs.qpos[0])) < 0.02


def test_a_joint_that_mimics_a_fixed_one_does_not_follow_and_says_so() -> None:
    assert (
        "joint k does not follow i (<mimic>), since i is fixed, as in MuJoCo"
        in read(follower('<mimic joint="i"/>', kind="fixed")).notes
    )


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (urdf(), "its XML has no link; a robot needs one at least"),
        (urdf(link("a"), link("a")), "there are 2 links a; give each a name that no other has"),
        (urdf("<link/>"), "a link has no name; give it one"),
        (
            urdf(link("a"), link("b"), joint("j", "a", "b", limit='<limit lower="-pi" upper="1" effort="1"/>')),
            "joint j: lower='-pi' of its <limit> is not a finite number; give it one",
        ),
        (
            urdf(link("a", inertia='<inertia ixx=".1" iyy=".1" izz=".1"/>')),
            "link a: its <inertia> has no ixy; give it one",
        ),
        (urdf(link("a", inertia="")), "link a: its <inertial> has no <inertia>; give it one"),
        (
            urdf(link("a").replace("0.1 0 0", "0.1,0,0")),
            "link a: xyz='0.1,0,0' of its <origin> is not 3 finite numbers; give it as many, without commas",
        ),
        (urdf(link("a", "<collision/>")), "link a: its <collision> has no <geometry>; give it one"),
        (
            urdf(link("a"), link("b"), joint("i", "a", "b"), joint("k", "b", "a")),
            "links move each other in a circle, b below a below b (joint i, k); leave out one of these joints",
        ),
        (urdf(link("a"), joint("i", "a", "a")), "links move each other in a circle, a below a (joint i)"),
        (urdf(link("a"), link("b"), joint("i", "q", "b")), "joint i: the parent 'q' is not a link of the file"),
        (follower('<mimic joint="nope"/>'), "joint k mimics 'nope', which is not a joint of the file; available: i"),
        (follower('<mimic joint="k"/>'), "joint k mimics itself"),
        (
            urdf(link("a"), link("b"), link("c"), joint("i", "a", "b"), joint("f", "b", "c", kind="floating")),
            "joint f floats below link b, but only a root can move freely; give c, and what is below it, a file and a Robot",
        ),
        (urdf(link("a"), "<xacro:leg/>"), "it has macros of xacro; expand it with xacro first"),
        ('<robot name="r"><xacro:leg/></robot>', "it has macros of xacro; expand it with xacro first"),
    ],
)
def test_what_is_wrong_with_a_urdf_file_is_named(text: str, words: str) -> None:
    with pytest.raises(ValueError) as refused:
        Robot(text).read()
    assert words in str(refused.value) and "\n" not in str(refused.value)


def test_a_floating_joint_at_the_root_can_be_left_out_as_its_refusal_says() -> None:
    with pytest.raises(
        ValueError, match=r"leave out that joint and link a, and b moves freely with Robot\(..., fixed=False\)"
    ):
        read(urdf(link("a"), link("b"), joint("f", "a", "b", kind="floating")))
    reading = read(urdf(link("b")), fixed=False)
    assert reading.reference is not None and reading.reference.model.nq == 7


@pytest.mark.parametrize("ending", ["urdf", "xml"])
def test_a_file_is_read_in_the_encoding_that_it_declares(ending: str, tmp_path: Path) -> None:
    texts = {
        "urdf": urdf("<!-- ü -->", link("a"), link("größe"), joint("j", "a", "größe")),
        "xml": '<mujoco><worldbody><!-- ü --><body name="größe"><joint name="j"/><geom size=".1"/></body></worldbody></mujoco>',
    }
    file = tmp_path / f"robot.{ending}"
    file.write_bytes(f'<?xml version="1.0" encoding="ISO-8859-1"?>\n{texts[ending]}'.encode("latin-1"))
    assert "body größe" in read(file).identity.elements
    file.write_bytes(texts[ending].encode("latin-1"))
    with pytest.raises(ValueError, match=r"is not text in UTF-8 .*declare its encoding in its first line"):
        read(file)
