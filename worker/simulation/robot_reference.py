"""The reference for a robot: its file as MuJoCo's own compiler reads it, which says what the robot must be."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import mujoco
import newton
import numpy as np

from shared_store.contract.error_text import nearest
from worker.simulation import robot_files, robot_floor, robot_urdf
from worker.simulation.patterns import check_ignored
from worker.simulation.robot_elements import kind_of, name_of, some, word_of
from worker.simulation.robot_files import RobotFile, asset_folders, missing_asset

if TYPE_CHECKING:
    from worker.simulation.robot import Robot

_KINDS = {"jnt": "joint", "dof": "dof", "eq": "equality"} | {
    kind: kind for kind in ("body", "geom", "site", "tendon", "actuator")
}
"""Kinds of elements, by the prefix of their fields in ``mujoco.MjModel``."""


@dataclass(frozen=True)
class ReferenceModel:
    """The compiled model of a robot's file.

    Attributes:
        model: ``mujoco.MjModel``.
        notes: What MuJoCo had to correct, one sentence each.
        looks: What is only seen and is lost where the robot is built from :attr:`model`, such as ``"textures"``.
        sensors: Name and kind of each of the file's own sensors, which nothing here reads.
    """

    model: Any
    notes: tuple[str, ...] = ()
    looks: str = ""
    sensors: tuple[tuple[str, str], ...] = ()


def compile_file(file: RobotFile, robot: Robot, shown: str) -> ReferenceModel:
    """Compile an MJCF or URDF file.

    Args:
        file: The file, whose ``spec`` is changed and compiled.
        robot: Says which geoms and sites to leave out, and whether its root is fixed to the world.
        shown: The file's name, for errors.

    Raises:
        ValueError: MuJoCo refuses the file; the message names the element. Or a pattern matches nothing.
    """
    ignored = robot.ignore
    notes: list[str] = []
    if file.format == "urdf":
        spec, looks = robot_urdf.specification(file, shown, notes)
    else:
        spec, looks = file.spec, ""  # not a copy: MjSpec.copy drops actuators of unknown targets
    sensors = tuple((sensor.name, word_of(mujoco.mjtSensor, sensor.type)) for sensor in spec.sensors)
    for element in (*spec.sensors, *spec.keys):
        spec.delete(element)  # sensors may name places that do not exist, and poses do not fit another root
    check_ignored(
        [element.name for element in (*spec.geoms, *spec.sites) if element.name], ignored, f"geom or site of {shown}"
    )

    def is_ignored(name: str) -> bool:
        return any(fnmatchcase(name, pattern) for pattern in ignored)

    floors = robot_floor.compiled(spec, is_ignored)
    left_out = _leave_out(spec, is_ignored, notes)
    looks = _without_looks(spec, file.source, notes) or looks
    if robot.fixed is not None:
        _set_root(spec, robot.fixed, shown)
    if spec.option.solver == mujoco.mjtSolver.mjSOL_PGS:
        notes.append("the file asks for the solver PGS, which MuJoCo-Warp lacks: worlds use Newton's method")
    if spec.option.noslip_iterations:
        notes.append("noslip_iterations of the file are not used: a task's solver_options have none")
    model = _compiled(spec, partial(_refusal, spec, file.source, left_out, shown), notes)
    notes += _settle_ranges(model)
    _check_numbers(model, shown)
    is_placed = robot.position is None and robot.rotation is None
    has_contacts = not any(collision.only for collision in robot.collisions)
    notes += robot_floor.notes(model, floors, is_placed=is_placed, has_contacts=has_contacts)
    return ReferenceModel(model, tuple(notes), looks, sensors)


def _leave_out(spec: Any, is_ignored: Callable[[str], bool], notes: list[str]) -> list[str]:
    """Leave out ignored geoms and sites, and the contact pairs of such geoms, which are noted.

    Returns:
        The names of the geoms and sites.
    """
    elements = [element for element in (*spec.geoms, *spec.sites) if is_ignored(element.name)]
    left_out = [element.name for element in elements]
    for element in elements:
        spec.delete(element)
    for pair in spec.pairs:
        names = pair.geomname1, pair.geomname2
        missing = [name for name in names if name in left_out]
        if missing:
            notes.append(
                f"the contact pair of {names[0]} and {names[1]} is left out, since {missing[0]} is; ignore=() keeps both"
            )
            spec.delete(pair)
    return left_out


def _without_looks(spec: Any, source: str, notes: list[str]) -> str:
    """Take textures and skins, which move nothing, from a file, and note those that are missing.

    Returns:
        What of them a picture would have shown: textures of meshes.
    """
    names = {texture.name or Path(texture.file).stem for texture in spec.textures}
    files = [file for texture in spec.textures for file in (texture.file, *texture.cubefiles)]
    missing = _missing(files, source, "texturedir") + _missing([skin.file for skin in spec.skins], source, "meshdir")
    textured = {material.name for material in spec.materials if any(material.textures)}
    meshes = [geom for geom in spec.geoms if geom.type == mujoco.mjtGeom.mjGEOM_MESH]
    for material in spec.materials:
        missing += [name for name in material.textures if name and name not in names]
        material.textures = [""] * len(material.textures)
    for light in spec.lights:
        light.texture = ""
    if missing:
        notes.append(f"pictures lack textures or skins that the file names and that are missing ({some(missing)})")
    for element in (*spec.textures, *spec.skins):
        spec.delete(element)
    return "textures" if any(geom.material in textured for geom in meshes) else ""


def _missing(files: Sequence[str], source: str, kind: str) -> list[str]:
    """The files that are in none of the folders of assets, with their paths or, as ``strippath`` wants it, without."""
    folders = [folder / inside for folder, inside in asset_folders(source, kind)] if any(files) else []
    names = [(file, (file, file.replace("\\", "/").rpartition("/")[2])) for file in files if file]
    return [file for file, forms in names if not any((folder / form).is_file() for folder in folders for form in forms)]


def _set_root(spec: Any, fixed: bool, shown: str) -> None:
    """Fix the root bodies to the world, or let them move freely; refuse to take a joint away that something drives or holds."""
    on_joints = (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)
    ends = {actuator.target for actuator in spec.actuators if actuator.trntype in on_joints}
    joined = (equality for equality in spec.equalities if equality.type == mujoco.mjtEq.mjEQ_JOINT)
    ends |= {name for equality in joined for name in (equality.name1, equality.name2)}
    ends |= {
        wrap.target.name for tendon in spec.tendons for wrap in tendon.path if wrap.type == mujoco.mjtWrap.mjWRAP_JOINT
    }
    for body in spec.worldbody.bodies:
        name = ""
        for joint in body.joints:
            if joint.type == mujoco.mjtJoint.mjJNT_FREE and not fixed:
                name = joint.name
            elif joint.name and joint.name in ends:
                raise ValueError(
                    f"{shown}: fixed={fixed} would take the joint {joint.name} of the root {body.name}, which an actuator, a tendon or an "
                    "equality of the file needs; leave fixed out, and the root moves as in the file"
                )
            spec.delete(joint)
        if not fixed and not body.mocap:
            body.add_freejoint(name=name)


_LIMITS = [
    *((kind, limit) for kind in ("jnt", "tendon") for limit in ("", "actfrc")),
    *(("actuator", limit) for limit in ("ctrl", "force", "act")),
]
"""What ``mujoco.MjModel`` limits: prefixes of its fields."""


def _settle_ranges(model: Any) -> Iterator[str]:
    """Ranges that are infinite on one side get Newton's number for that, and on both sides no limit, which is the same.

    Yields:
        What has a range without any values, and so no limit in MuJoCo, one sentence for each kind.
    """
    for kind, limit in _LIMITS:
        ranges, limited = getattr(model, f"{kind}_{limit}range"), getattr(model, f"{kind}_{limit}limited")
        is_open = np.isneginf(ranges[:, 0]) & np.isposinf(ranges[:, 1])
        limited[is_open], ranges[is_open] = 0, 0.0
        ranges[np.isneginf(ranges[:, 0]), 0] = -newton.MAXVAL
        ranges[np.isposinf(ranges[:, 1]), 1] = newton.MAXVAL
        element, names = _KINDS[kind], []
        for index in np.flatnonzero((ranges[:, 0] >= ranges[:, 1]) & ranges.any(1) & (limited == 0)):
            name = name_of(model, kind_of(element), int(index))
            names.append(f"{element} {name} ({ranges[index, 0]:.4g} to {ranges[index, 1]:.4g})")
        if names:
            yield f"MuJoCo ignores an empty {limit}range: {some(names)}"


def _compiled(spec: Any, refusal: Callable[[Exception], ValueError], notes: list[str]) -> Any:
    """Compile, and where only inertias are impossible, once more with MuJoCo's own correction, which is noted."""
    with robot_files.quiet():
        for is_balanced in (False, True):
            spec.compiler.balanceinertia |= is_balanced
            try:
                model = spec.compile()
                break
            except ValueError as error:
                if is_balanced or "balanceinertia" not in str(error):
                    raise refusal(error) from error
    if not is_balanced:
        return model
    for body in spec.bodies:
        moments = _moments(body)
        if body.explicitinertial and 2.0 * max(moments) > sum(moments) * (1.0 + 1e-9):
            listed = " ".join(f"{moment:.4g}" for moment in moments)
            corrected = " ".join(f"{moment:.4g}" for moment in model.body_inertia[body.id])
            notes.append(
                f"body {name_of(model, mujoco.mjtObj.mjOBJ_BODY, body.id)}: no body has the principal moments of inertia {listed}, "
                f"since one is greater than the sum of the others; they are {corrected} here (MuJoCo's balanceinertia)"
            )
    return model


def _moments(body: Any) -> list[float]:
    if np.isnan(body.fullinertia).any():
        return [float(moment) for moment in body.inertia]
    xx, yy, zz, xy, xz, yz = body.fullinertia
    return [float(moment) for moment in np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])]


_REMEDIES = (
    (
        "mjMINVAL",
        "give that body an <inertial> of a mass greater than 0, or a geom that has one; or fix it to its parent",
    ),
    ("negative", "give a value of 0 or more"),
    ("only be used on top level", "move that body into <worldbody>, or fix it to its parent"),
)
"""What to do, by a part of MuJoCo's message."""


def _refusal(spec: Any, source: str, left_out: Sequence[str], shown: str, error: Exception) -> ValueError:
    text = re.sub(r"\s+", " ", str(error)).strip().removeprefix("Error: ")
    asset = re.search(r"^Error opening file '([^']*)'", text)
    if asset:
        return missing_asset(spec, source, asset.group(1), shown)
    unknown = re.search(r"unknown transmission target '([^']*)'", text)
    if unknown:
        names = [element.name for element in (*spec.joints, *spec.tendons, *spec.sites, *spec.bodies) if element.name]
        return ValueError(f"{shown}: {text}; {nearest(unknown.group(1), names)}")
    remedy = next((f"; {words}" for part, words in _REMEDIES if part in text), "")
    if any(f"'{name}' not found" in text for name in left_out):
        remedy = "; the robot's ignore leaves it out: give ignore=() to keep it"
    return ValueError(f"{shown}: MuJoCo refuses it: {text}{remedy}")


def _check_numbers(model: Any, shown: str) -> None:
    """Refuse numbers that are not finite: MuJoCo only warns, and every step would reset every world."""
    for field in dir(model):
        kind, _, value = field.partition("_")
        if kind not in _KINDS or not value:
            continue
        array = getattr(model, field)
        if not isinstance(array, np.ndarray) or array.dtype.kind != "f" or np.isfinite(array).all():
            continue
        index = int(np.argwhere(~np.isfinite(array))[0][0])
        element = "joint" if kind == "dof" else _KINDS[kind]
        name = name_of(model, kind_of(element), int(model.dof_jntid[index]) if kind == "dof" else index)
        raise ValueError(f"{shown}: {element} {name}: {value} is not a finite number; give it one")
