"""A URDF file as MuJoCo's parser takes it, and what is wrong with it, by the names of its links and joints."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any
from xml.etree import ElementTree

import numpy as np

from shared_store.contract.error_text import nearest
from worker.simulation import robot_files
from worker.simulation.robot_elements import some
from worker.simulation.robot_files import RobotFile

JOINTS = ("revolute", "continuous", "prismatic", "fixed", "floating", "planar")
FOLLOWING = ("revolute", "continuous", "prismatic")
"""Types of joints of which one can follow another."""
LIMITS = ("lower", "upper", "effort")
NUMBERS = {
    "mass": {"value": 1},
    "inertia": dict.fromkeys(("ixx", "iyy", "izz", "ixy", "ixz", "iyz"), 1),
    "origin": {"xyz": 3, "rpy": 3},
    "axis": {"xyz": 3},
    "dynamics": {"damping": 1, "friction": 1},
    "limit": dict.fromkeys(LIMITS, 1),
    "mimic": {"multiplier": 1, "offset": 1},
    "box": {"size": 3},
    "sphere": {"radius": 1},
    "cylinder": {"radius": 1, "length": 1},
    "capsule": {"radius": 1, "length": 1},
}
"""How many numbers MuJoCo reads in an attribute, by element."""
NEEDED = {"mass", "inertia", "box", "sphere", "cylinder", "capsule"}
"""The elements of :data:`NUMBERS` of which MuJoCo needs all attributes."""
PARTS = {"inertial": ("mass", "inertia"), "collision": ("geometry",)}
"""What MuJoCo needs in an element."""


def specification(file: RobotFile, shown: str, notes: list[str]) -> tuple[Any, str]:
    """A URDF file as MuJoCo reads it, with links that only fixed joints hold as bodies of their own, and without visuals.

    Returns:
        The ``mujoco.MjSpec``, and what was taken of what is only seen. What a user should know is added to ``notes``, one sentence each.

    Raises:
        ValueError: The file is wrong; the message names the link or joint.
    """
    root = robot_files.urdf_root(file.source, shown)
    looks = "visuals" if root.find("link/visual") is not None else ""
    _take_visuals(root, file.source, shown, notes)
    joints = root.findall("joint")
    for element in (*root.findall("link"), *joints):
        _check_values(element, shown)
    for joint in joints:
        if (kind := joint.get("type")) not in JOINTS:
            raise ValueError(f"{shown}: joint {joint.get('name')} is of type {kind!r}; URDF has {', '.join(JOINTS)}")
    _check_tree(root, joints, shown)
    _check_mimics(joints, shown, notes)
    notes += _unlimited(joints)
    compiler = root
    for tag in ("mujoco", "compiler"):
        found = compiler.find(tag)
        compiler = ElementTree.SubElement(compiler, tag) if found is None else found
    compiler.attrib.update(strippath="false", fusestatic="false", discardvisual="true")
    try:
        return robot_files.parse_mjcf(ElementTree.tostring(root, encoding="unicode"), shown), looks
    except ValueError as error:  # its lines are of the XML that is written here
        raise ValueError(re.sub(r",? line \d+", "", str(error))) from error


def _take_visuals(root: ElementTree.Element, source: str, shown: str, notes: list[str]) -> None:
    """Take visuals from the links, and meshes that MuJoCo can't read."""
    for link in root.iter("link"):
        for visual in link.findall("visual"):
            link.remove(visual)
        for collision in link.findall("collision"):
            mesh = collision.find("geometry/mesh")
            if mesh is None:
                continue
            place = robot_files.urdf_mesh(source, mesh.get("filename", ""), shown)
            if place.suffix.lower() in (".stl", ".obj", ".msh"):
                mesh.set("filename", str(place))
            else:
                link.remove(collision)
                notes.append(
                    f"link {link.get('name')}: MuJoCo's compiler can't read {place.name}, so the shape of this collision geom "
                    "is not compared"
                )


def _check_values(element: ElementTree.Element, shown: str) -> None:
    """Refuse what MuJoCo can't read in a link or a joint, by its name; and negative masses."""
    where = f"{shown}: {element.tag} {element.get('name')}"
    if not element.get("name"):
        raise ValueError(f"{shown}: a {element.tag} has no name; give it one")
    for found in element.iter():
        if lacking := next((tag for tag in PARTS.get(found.tag, ()) if found.find(tag) is None), None):
            raise ValueError(f"{where}: its <{found.tag}> has no <{lacking}>; give it one")
        for name, count in NUMBERS.get(found.tag, {}).items():
            text = found.get(name)
            if text is None and found.tag in NEEDED:
                raise ValueError(f"{where}: its <{found.tag}> has no {name}; give it one")
            if text is not None:
                _check_number(f"{where}: {name}={text!r} of its <{found.tag}>", text, count)
        if found.tag == "mass" and float(found.get("value", 0.0)) < 0.0:
            raise ValueError(f"{where}: its mass is {found.get('value')}; give it one greater than 0")


def _check_number(what: str, text: str, count: int) -> None:
    try:
        numbers = [float(word) for word in text.split()]
    except ValueError:
        numbers = []
    if len(numbers) != count or not np.isfinite(numbers).all():
        expected = (
            "a finite number; give it one" if count == 1 else f"{count} finite numbers; give it as many, without commas"
        )
        raise ValueError(f"{what} is not {expected}")


def _ends(joint: ElementTree.Element, shown: str, links: list[str]) -> tuple[str, str]:
    """The names of a joint's parent and child."""
    found = []
    for word in ("parent", "child"):
        end = joint.find(word)
        link = "" if end is None else end.get("link", "")
        if link not in links:
            what = f"the {word} {link!r} is not a link of the file" if link else f"it has no <{word} link=…>"
            raise ValueError(f"{shown}: joint {joint.get('name')}: {what}; {nearest(link, links)}")
        found.append(link)
    return found[0], found[1]


def _check_tree(root: ElementTree.Element, joints: list[ElementTree.Element], shown: str) -> None:
    """Refuse what is not a tree of links, and joints that float below a link."""
    links = [link.get("name", "") for link in root.findall("link")]
    if not links:
        raise ValueError(f"{shown} has no link; a robot needs one at least")
    if again := next((name for name in links if links.count(name) > 1), None):
        raise ValueError(f"{shown}: there are {links.count(again)} links {again}; give each a name that no other has")
    above: dict[str, tuple[str, str]] = {}
    for joint in joints:
        name = joint.get("name", "")
        parent, child = _ends(joint, shown, links)
        if child in above:
            raise ValueError(
                f"{shown}: link {child} closes a loop: the joints {above[child][1]} and {name} both move it; leave out one "
                "of them, or use MJCF: its <equality> can hold the two ends together"
            )
        above[child] = parent, name
    for link in above:
        path = [link]
        while path[-1] in above and path[-1] not in path[:-1]:
            path.append(above[path[-1]][0])
        if path[-1] in path[:-1]:
            cycle = path[path.index(path[-1]) :]
            moved = some([above[each][1] for each in cycle[:-1]])
            raise ValueError(
                f"{shown}: links move each other in a circle, {' below '.join(cycle)} (joint {moved}); leave out one of these joints"
            )
    _check_floating(joints, above, shown)


def _check_floating(joints: list[ElementTree.Element], above: dict[str, tuple[str, str]], shown: str) -> None:
    floating = {joint.get("name") for joint in joints if joint.get("type") == "floating"}
    for child, (parent, name) in above.items():
        if name not in floating or parent == "world":
            continue
        remedy = f"leave out that joint and link {parent}, and {child} moves freely with Robot(..., fixed=False)"
        if parent in above or sum(other == parent for other, _ in above.values()) > 1:
            remedy = f"give {child}, and what is below it, a file and a Robot of its own"
        raise ValueError(f"{shown}: joint {name} floats below link {parent}, but only a root can move freely; {remedy}")


def _check_mimics(joints: list[ElementTree.Element], shown: str, notes: list[str]) -> None:
    """Refuse joints that follow none, and note those that MuJoCo does not let follow."""
    kinds = {joint.get("name", ""): joint.get("type") for joint in joints}
    for joint in joints:
        mimic, name = joint.find("mimic"), joint.get("name", "")
        if mimic is None:
            continue
        leader = mimic.get("joint", "")
        if leader not in kinds or leader == name:
            what = "itself" if leader == name else f"{leader!r}, which is not a joint of the file"
            others = [other for other in kinds if other != name]
            raise ValueError(f"{shown}: joint {name} mimics {what}; {nearest(leader, others)}")
        if still := [each for each in (name, leader) if kinds[each] not in FOLLOWING]:
            notes.append(
                f"joint {name} does not follow {leader} (<mimic>), since {still[0]} is {kinds[still[0]]}, as in MuJoCo"
            )


def _unlimited(joints: list[ElementTree.Element]) -> Iterator[str]:
    """Which joints of a URDF file have no limits, though URDF wants some, or a negative one."""
    unlimited, negative = [], []
    for joint in joints:
        limit, name = joint.find("limit"), str(joint.get("name"))
        lower, upper, effort = (0.0 if limit is None else float(limit.get(word, "0")) for word in LIMITS)
        if joint.get("type") in ("revolute", "prismatic") and lower == upper == 0.0:
            unlimited.append(name)
        if effort < 0.0:
            negative.append(name)
    if unlimited:
        yield f"joints without <limit>, or whose lower and upper are both 0, move without end, as in MuJoCo: {some(unlimited)}"
    if negative:
        yield f"MuJoCo ignores a negative effort: joint {some(negative)}"
