"""What elements of a compiled model connect: the ends of equalities, actuators, tendons and contact pairs."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

from worker.simulation.robot_elements import word_of
from worker.simulation.robot_values import matrix

Ends = tuple[tuple[str, int], ...]
"""Kind and index of each element that another one connects; the index is -1 where there is none."""
TARGETS = {
    "joint": ("joint",),
    "jointinparent": ("joint",),
    "tendon": ("tendon",),
    "body": ("body",),
    "site": ("site", "refsite"),
    "slidercrank": ("cranksite", "slidersite"),
}
"""Attributes of MJCF that name an actuator's ends, by its transmission."""


def actuator_ends(model: Any, actuator: int) -> Ends:
    """What an actuator drives, in the order of :data:`TARGETS`; empty for a transmission that is not among them."""
    words = TARGETS.get(word_of(mujoco.mjtTrn, model.actuator_trntype[actuator]), ())
    indices = model.actuator_trnid[actuator]
    return tuple(("site" if "site" in word else word, int(index)) for word, index in zip(words, indices, strict=False))


def equality_ends(model: Any, equality: int) -> Ends:
    """The bodies of a connect or a weld, or the joints or tendons of another equality."""
    kind = word_of(mujoco.mjtEq, model.eq_type[equality])
    indices = [int(model.eq_obj1id[equality]), int(model.eq_obj2id[equality])]
    if kind in ("connect", "weld"):
        if _of_sites(model, equality):
            indices = [int(body) for body in model.site_bodyid[indices]]
        kind = "body"
    return tuple((kind, index) for index in indices)


def tendon_ends(model: Any, tendon: int) -> Ends:
    """The elements of a tendon's path, in their order; of a wrapped geom, its side site too."""
    found = []
    for wrap in _wraps(model, tendon):
        kind, index = word_of(mujoco.mjtWrap, model.wrap_type[wrap]), int(model.wrap_objid[wrap])
        found.append((kind, index) if kind in ("joint", "site", "pulley") else ("geom", index))
        if kind in ("sphere", "cylinder"):
            found.append(("site", int(model.wrap_prm[wrap])))
    return tuple(found)


def pair_ends(model: Any, pair: int) -> Ends:
    """The geoms of a contact pair."""
    return ("geom", int(model.pair_geom1[pair])), ("geom", int(model.pair_geom2[pair]))


def tendon_numbers(model: Any, tendon: int) -> Any:
    """Coefficients of a tendon's joints and divisors of its pulleys, in the order of its path."""
    numbered = (int(mujoco.mjtWrap.mjWRAP_JOINT), int(mujoco.mjtWrap.mjWRAP_PULLEY))
    return np.array([model.wrap_prm[wrap] for wrap in _wraps(model, tendon) if model.wrap_type[wrap] in numbered])


def effective_geoms(model: Any) -> list[int]:
    """The geoms that do anything: they touch by their masks or in a contact pair, or a tendon wraps them."""
    kinds = (int(mujoco.mjtWrap.mjWRAP_SPHERE), int(mujoco.mjtWrap.mjWRAP_CYLINDER))
    named = (model.pair_geom1, model.pair_geom2, model.wrap_objid[np.isin(model.wrap_type, kinds)])
    masked = (model.geom_contype | model.geom_conaffinity).nonzero()[0]
    return sorted({int(geom) for group in (*named, masked) for geom in group})


def held(model: Any, equality: int) -> dict[str, Any]:
    """What an equality holds, in forms that do not depend on whether it names bodies or sites.

    Returns:
        By name: ``anchor1`` and ``anchor2``, the points that are held together, each in its body's frame [m]; for a weld also ``turn``,
        the rotation matrix of the second body in the first one's frame, and ``torquescale``; for other equalities ``polycoef``. Source:
        MuJoCo's ``mj_instantiateConnect`` and ``mj_instantiateWeld``.
    """
    kind, data = word_of(mujoco.mjtEq, model.eq_type[equality]), model.eq_data[equality]
    if kind not in ("connect", "weld"):
        return {"polycoef": data[:5]}
    if _of_sites(model, equality):
        sites = [int(model.eq_obj1id[equality]), int(model.eq_obj2id[equality])]
        anchors = [model.site_pos[site] for site in sites]
        first, second = (matrix(model.site_quat[site]) for site in sites)
        turn = first @ second.T
    else:
        anchors = [data[:3], data[3:6]] if kind == "connect" else [data[3:6], data[:3]]
        turn = matrix(data[6:10])
    found = {"anchor1": anchors[0], "anchor2": anchors[1]}
    return found if kind == "connect" else {**found, "turn": turn, "torquescale": data[10]}


def _of_sites(model: Any, equality: int) -> bool:
    return bool(model.eq_objtype[equality] == int(mujoco.mjtObj.mjOBJ_SITE))


def _wraps(model: Any, tendon: int) -> range:
    return range(model.tendon_adr[tendon], model.tendon_adr[tendon] + model.tendon_num[tendon])
