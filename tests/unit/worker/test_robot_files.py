"""MJCF files of several parts: what MuJoCo finds, Muster finds; what is missing is named."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mujoco
import pytest

from tests.support.worker.robot_texts import BOX, HINGE, SITE, mjcf, read, twins

SPRING = '<joint name="j" axis="0 1 0" springdamper=".1 1"/>'
"""Newton's importer reads it otherwise, so that the file is written anew."""
TETRAHEDRON = "v 0 0 0\nv .1 0 0\nv 0 .1 0\nv 0 0 .2\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
SOLID = '<geom type="mesh" mesh="tet"/>'


def written(folder: Path, files: dict[str, str]) -> Path:
    for name, text in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    return folder / "robot.xml"


def include(name: str) -> str:
    return f"<mujocoinclude>{name}</mujocoinclude>"


@pytest.mark.parametrize("joint", [HINGE, SPRING])
@pytest.mark.parametrize("integrator", ["Euler", "RK4"])
@pytest.mark.parametrize("inner", ["deep/option.xml", "parts/deep/option.xml"])
def test_an_included_file_may_name_the_integrator(tmp_path: Path, joint: str, integrator: str, inner: str) -> None:
    """MuJoCo looks for what it includes in turn beside the first file, then beside itself."""
    files = {
        "robot.xml": mjcf(joint + BOX, before='<include file="parts/outer.xml"/>'),
        "parts/outer.xml": include(f'<!-- a -- b --><include file="{inner}"/>'),
        "parts/deep/option.xml": include(f'<option integrator="{integrator}"/>'),
    }
    values: Any = read(str(written(tmp_path, files))).builder.custom_attributes["mujoco:integrator"].values
    assert (values or {}).get(0) == int(mujoco.mjtIntegrator.__members__[f"mjINT_{integrator.upper()}"])


def test_a_value_of_an_included_file_that_is_not_a_number_is_named(tmp_path: Path) -> None:
    files = {
        "robot.xml": mjcf(HINGE + BOX, "", before='<include file="actuators.xml"/>'),
        "actuators.xml": include('<actuator><motor name="m" joint="j" gear="nan"/></actuator>'),
    }
    with pytest.raises(ValueError, match=r"gear='nan' of <motor name='m'> is not a number; give it a number"):
        read(str(written(tmp_path, files)))


def asset(compiler: str, mesh: str, joint: str = HINGE) -> str:
    return mjcf(joint + SOLID, before=f'<compiler {compiler}/><asset><mesh name="tet" file="{mesh}"/></asset>')


@pytest.mark.parametrize(
    ("compiler", "mesh"),
    [
        ('meshdir="m"', "tet.obj"),
        ('assetdir="m"', "sub/tet.obj"),
        ('meshdir="./m/../m/"', "../m/tet.obj"),
        ('meshdir="m" strippath="true"', "C:/x/tet.obj"),
        ('meshdir="m"', "sub\\tet.obj"),
    ],
)
@pytest.mark.parametrize("joint", [HINGE, SPRING])
def test_meshes_are_found_where_mujoco_finds_them(tmp_path: Path, compiler: str, mesh: str, joint: str) -> None:
    files = {
        "robot.xml": asset(compiler, mesh, joint),
        **dict.fromkeys(("m/tet.obj", "m/sub/tet.obj"), TETRAHEDRON),
    }
    reading = read(str(written(tmp_path, files)))
    assert twins(reading).built.nmesh == 1 and not reading.notes


ATTACHED = {
    "robot.xml": mjcf(
        f'{HINGE}{BOX}<attach model="arm" body="up" prefix="p_"/>',
        before='<asset><model name="arm" file="child/arm.xml"/></asset>',
    ),
    "child/arm.xml": '<mujoco model="arm"><compiler meshdir="m" texturedir="t"/><asset><mesh name="tet" file="tet.obj"/>'
    '<texture name="x" type="2d" file="x.png"/></asset><worldbody><body name="up"><joint name="k"/>'
    '<geom type="mesh" mesh="tet"/></body></worldbody></mujoco>',
    "child/m/tet.obj": TETRAHEDRON,
    "child/t/x.png": "",
}


def test_an_attached_model_has_its_own_folders_of_assets(tmp_path: Path) -> None:
    reading = read(str(written(tmp_path, ATTACHED)))
    assert twins(reading).built.njnt == 2 and not reading.notes
    (tmp_path / "child/t/x.png").unlink()
    assert read(str(tmp_path / "robot.xml")).notes == (
        "pictures lack textures or skins that the file names and that are missing (x.png)",
    )
    (tmp_path / "child/m/tet.obj").rename(tmp_path / "child/m/tets.obj")
    with pytest.raises(ValueError, match=r"its mesh tet\.obj is missing in .*child/m; did you mean tets\.obj\?"):
        read(str(tmp_path / "robot.xml"))


@pytest.mark.parametrize(
    ("compiler", "mesh", "words"),
    [
        ('meshdir="m"', "sub/te.obj", r"its mesh sub/te\.obj is missing in .*/m/sub; did you mean tet\.obj\?"),
        ('meshdir="./m/../m/"', "te.obj", r"its mesh te\.obj is missing in .*; did you mean tet\.obj\?"),
        ('meshdir="m" strippath="true"', "C:/x/te.obj", r"its mesh te\.obj is missing in .*/m; did you mean tet"),
        ('meshdir="m"', "/nowhere/te.obj", r"its mesh /nowhere/te\.obj is missing in /nowhere; that folder does not"),
    ],
)
def test_a_missing_mesh_is_named(tmp_path: Path, compiler: str, mesh: str, words: str) -> None:
    files = {"robot.xml": asset(compiler, mesh), **dict.fromkeys(("m/tet.obj", "m/sub/tet.obj"), TETRAHEDRON)}
    with pytest.raises(ValueError, match=words):
        read(str(written(tmp_path, files)))


def test_comments_may_contain_dashes() -> None:
    assert not read(mjcf(f"<!-- a -->{HINGE}{BOX}")).corrected
    assert read(mjcf(f"<!----- a ----->{HINGE}{BOX}")).reference is not None


def test_without_visuals_geoms_that_tendons_wrap_are_kept() -> None:
    geoms = '<geom name="w" size=".05" pos=".1 0 0" contype="0" conaffinity="0"/><geom size=".05" contype="0" conaffinity="0"/>'
    tendon = '<spatial name="q" stiffness="5"><site site="s"/><geom geom="w"/><site site="t"/></spatial>'
    reading = read(
        mjcf(
            f'<site name="s" pos=".3 0 0"/>{SITE}{HINGE}<geom name="g" size=".1"/>{geoms}', f"<tendon>{tendon}</tendon>"
        ),
        visuals=False,
    )
    assert [label.rpartition("/")[2] for label in reading.builder.shape_label] == ["w", "g", "s", "t"]
    assert twins(reading).built.tendon_num.tolist() == [3]


def test_a_pattern_to_leave_out_that_matches_nothing_is_refused_except_for_floors() -> None:
    text = mjcf(HINGE + BOX.replace("<geom", '<geom name="trunk"') + BOX)
    assert read(text, ignore=("floor", "ground", "tr*")).builder.shape_count == 1
    with pytest.raises(ValueError, match=r"no geom or site of its XML matches 'trunkk'; did you mean trunk\?"):
        read(text, ignore=("floor", "trunkk"))
