"""The floor of a robot's file, which is left out, compared with the ground plane of Muster that takes its place."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any

import mujoco
import numpy as np

from worker.simulation.patterns import FLOORS
from worker.simulation.robot_elements import name_of, some, word_of
from worker.simulation.robot_files import quiet

_GROUND = mujoco.MjSpec()
_GROUND.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=(1.0, 1.0, 1.0))
GROUND: Any = _GROUND.compile()
"""Muster's ground plane: MuJoCo's default values."""
KEEP = "to keep the file's floor, give Robot ignore=() and the task ground=False"
"""What to do where the difference matters."""
COEFFICIENTS = {1: 0, 3: 1, 4: 2, 6: 3}
"""How many of a geom's coefficients of friction count, by ``condim``."""


def compiled(spec: Any, is_ignored: Callable[[str], bool]) -> Any:
    """The floors of a parsed file that will be left out, compiled alone as ``mujoco.MjModel``; None: there are none that touch anything."""
    if not _floors(spec.worldbody, is_ignored):
        return None
    alone = spec.copy()
    floors = _floors(alone.worldbody, is_ignored)
    for geom in floors:
        geom.material = ""
    connecting = (alone.actuators, alone.tendons, alone.equalities, alone.pairs, alone.excludes, alone.sensors)
    others = (alone.keys, alone.flexes, alone.skins, alone.textures, alone.materials, alone.joints)
    names = {geom.name for geom in floors}
    rest = [geom for geom in alone.geoms if geom.name not in names]
    meshes = {name for geom in floors for name in (geom.meshname, geom.hfieldname)}
    assets = [asset for asset in (*alone.meshes, *alone.hfields) if asset.name not in meshes]
    for element in (*(each for group in (*connecting, *others) for each in group), *rest, *assets):
        alone.delete(element)
    try:
        with quiet():
            return alone.compile()
    except ValueError:  # then so does the whole file, which says why
        return None


def _floors(body: Any, is_ignored: Callable[[str], bool]) -> list[Any]:
    """The floors of a body and of the bodies that are fixed to it."""
    found = [geom for geom in body.geoms if geom.name in FLOORS and is_ignored(geom.name)]
    fixed = [child for child in body.bodies if not child.joints]
    return [
        *(geom for geom in found if geom.contype or geom.conaffinity),
        *(geom for child in fixed for geom in _floors(child, is_ignored)),
    ]


def notes(model: Any, floors: Any, *, is_placed: bool, has_contacts: bool) -> Iterator[str]:
    """What Muster's ground has otherwise than the floors of :func:`compiled`, one sentence each.

    Their place matters where the robot begins where its file puts it, and their contacts where its geoms touch as the file says.
    """
    for floor in range(floors.ngeom if floors else 0):
        name = f"the file's {name_of(floors, mujoco.mjtObj.mjOBJ_GEOM, floor)}"
        moving = [geom for geom in range(model.ngeom) if model.body_weldid[model.geom_bodyid[geom]]]
        in_file = {geom for geom in moving if _touch(model, geom, floors, floor)}
        in_muster = {geom for geom in moving if _touch(model, geom, GROUND, 0)}
        masks = f"contype {floors.geom_contype[floor]} and conaffinity {floors.geom_conaffinity[floor]}"
        if has_contacts and in_file - in_muster:
            yield (
                f"Muster's ground (contype 1 and conaffinity 1) does not hold what {name} ({masks}) holds: {_names(model, in_file - in_muster)}; "
                f"give these geoms other masks by collisions=(Collision(...),); or, {KEEP}"
            )
        if has_contacts and in_muster - in_file:
            yield f"Muster's ground touches what {name} ({masks}) does not: {_names(model, in_muster - in_file)}; {KEEP}"
        found = [*_place(floors, floor)] if is_placed else []
        found += _contacts(model, sorted(in_file & in_muster), floors, floor) if has_contacts else []
        if found:
            yield f"Muster's ground takes the place of {name}, which has another {', another '.join(found)}; {KEEP}"


def _names(model: Any, geoms: set[int]) -> str:
    return some([f"geom {name_of(model, mujoco.mjtObj.mjOBJ_GEOM, geom)}" for geom in sorted(geoms)])


def _touch(first: Any, geom: int, second: Any, other: int) -> bool:
    return bool(
        first.geom_contype[geom] & second.geom_conaffinity[other]
        or second.geom_contype[other] & first.geom_conaffinity[geom]
    )


def _place(floors: Any, floor: int) -> Iterator[str]:
    kind = word_of(mujoco.mjtGeom, floors.geom_type[floor])
    if kind != "plane":
        yield f"shape ({kind})"
        return
    data = mujoco.MjData(floors)
    mujoco.mj_kinematics(floors, data)
    normal = data.geom_xmat[floor].reshape(3, 3)[:, 2]
    height, tilt = float(data.geom_xpos[floor] @ normal), math.degrees(math.atan2(math.hypot(*normal[:2]), normal[2]))
    if abs(height) > 1e-6:
        yield f"height ({height:.4g} m)"
    if tilt > 1e-3:
        yield f"tilt ({tilt:.4g} degrees)"


def _contacts(model: Any, geoms: list[int], floors: Any, floor: int) -> Iterator[str]:
    """What contacts of the robot's geoms have otherwise, with the first geom and both values."""
    differing = {}
    for geom in geoms:
        theirs, mine = _contact(model, geom, floors, floor), _contact(model, geom, GROUND, 0)
        for word, value in theirs.items():
            count = min(value.size, mine[word].size)  # coefficients of friction that both contacts have
            if word not in differing and not np.allclose(value[:count], mine[word][:count]):
                numbers = [" ".join(f"{number:.4g}" for number in each) for each in (value, mine[word])]
                name = name_of(model, mujoco.mjtObj.mjOBJ_GEOM, geom)
                differing[word] = f"{word} (with geom {name} {numbers[0]}, here {numbers[1]})"
    yield from differing.values()


def _contact(first: Any, geom: int, second: Any, other: int) -> dict[str, Any]:
    """Parameters of the contact of two geoms. Source: MuJoCo's documentation, Computation, contact parameters."""
    ends = [(first, geom), (second, other)]
    ranks = [model.geom_priority[index] for model, index in ends]
    if ranks[0] != ranks[1]:
        ends = [ends[int(np.argmax(ranks))]] * 2
    condim = max(int(model.geom_condim[index]) for model, index in ends)
    frictions = np.maximum(*(model.geom_friction[index] for model, index in ends))
    weights = np.array([model.geom_solmix[index] for model, index in ends])
    total = weights.sum()
    weights = weights / total if total > mujoco.mjMINVAL else np.array([0.5, 0.5])
    solrefs, solimps = (
        np.array([getattr(model, field)[index] for model, index in ends]) for field in ("geom_solref", "geom_solimp")
    )
    return {
        "condim": np.array([condim]),
        "friction": frictions[: COEFFICIENTS[condim]],
        "solref": weights @ solrefs if (solrefs[:, 0] > 0.0).all() else solrefs.min(0),
        "solimp": weights @ solimps,
    }
