"""The elements of a compiled model: their names, what they connect, and which is which in two models of one robot."""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Any

import mujoco
import newton
import numpy as np
from newton.solvers import SolverMuJoCo

from shared_store.contract.error_text import enumerated

CARRIER = "__carries_joint_"
"""Part of the name of a body that only carries a joint: MuJoCo lets several joints stand between a body and its parent, each at another place.
Newton has one joint for each body, so all but the last of them move a body without mass."""
CARRIER_MASS = 1e-9
"""Its mass until the model is compiled [kg]: MuJoCo's compiler demands some of every body that moves."""
CARRIER_INERTIA = 4e-15
"""Its moments of inertia until then [kg m^2], little more than the compiler's least."""
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
Pairs = dict[int, int]
"""Index of an element in the built model, by its index in the file's."""


def matrix(quaternion: Any) -> Any:
    """Rotation matrix of a quaternion wxyz, shape ``(3, 3)``."""
    found = np.zeros(9)
    mujoco.mju_quat2Mat(found, np.asarray(quaternion, np.float64))
    return found.reshape(3, 3)


def quaternion(matrix: Any) -> Any:
    """Quaternion wxyz of a rotation matrix, shape ``(4,)``."""
    found = np.zeros(4)
    mujoco.mju_mat2Quat(found, np.ascontiguousarray(matrix, np.float64).ravel())
    return found


def name_of(model: Any, kind: mujoco.mjtObj, index: int) -> str:
    """Name of an element of a ``mujoco.MjModel``, or one made of its kind and its number where the file gives none."""
    name: str | None = mujoco.mj_id2name(model, kind, index)
    return name or f"{mujoco.mju_type2Str(kind)}_{index}"


def plain(name: str) -> str:
    """A name as Newton's importer keeps it: other characters than letters, digits and underscores become underscores."""
    return re.sub(r"\W", "_", name)


def short(label: str) -> str:
    """The last part of a label of Newton's, which is the element's name."""
    return label.rpartition("/")[2]


def kind_of(word: str) -> mujoco.mjtObj:
    """A kind of elements by its word in MJCF."""
    return mujoco.mjtObj.__members__[f"mjOBJ_{word.upper()}"]


def word_of(kind: Any, value: int) -> str:
    """The word of MJCF for a value of one of MuJoCo's enumerations."""
    return str(kind(int(value)).name.rpartition("_")[2].lower())


class Words:
    """The words of MJCF for values of one of MuJoCo's enumerations, as far as Newton's models have them."""

    def __init__(self, kind: Any, words: str) -> None:
        self._kind = kind
        prefix = next(iter(kind.__members__)).partition("_")[0]
        self._words = {int(kind.__members__[f"{prefix}_{word.upper()}"]): word for word in words.split()}

    def of(self, value: Any, element: str) -> str:
        """The word of a value of an element. Raises ValueError, with the element's name, where Newton has nothing of the kind."""
        if int(value) not in self._words:
            raise ValueError(
                f"{element} is of the kind {word_of(self._kind, value)!r}, which Newton's models don't have"
            )
        return self._words[int(value)]


COUNTS = {"body": "nbody", "joint": "njnt", "actuator": "nu", "equality": "neq"}
"""Fields of ``mujoco.MjModel`` that count elements, where they are not an n and the kind's word."""


def count_of(model: Any, kind: str) -> int:
    """Number of a model's elements of a kind."""
    return int(getattr(model, COUNTS.get(kind, f"n{kind}")))


def unique_names(model: Any, kind: str) -> list[str]:
    """Names of all elements of a kind, as Newton's importer keeps them and each once; made ones where the file gives none."""
    count = range(count_of(model, kind))
    named = {index: bool(mujoco.mj_id2name(model, kind_of(kind), index)) for index in count}
    names: dict[int, str] = {}
    taken: set[str] = set()
    for index in sorted(count, key=lambda each: not named[each]):  # the file's own names first
        name = plain(name_of(model, kind_of(kind), index))
        while name in taken:
            name += "_"
        taken.add(name)
        names[index] = name
    return [names[index] for index in count]


def names_of(model: Any, kind: str, indices: Iterable[int]) -> dict[int, str]:
    """Names of elements as Newton's importer keeps them, each once; empty where the file gives none."""
    names = unique_names(model, kind)
    return {index: names[index] if mujoco.mj_id2name(model, kind_of(kind), index) else "" for index in indices}


def paired(in_file: dict[int, str], here: dict[int, str]) -> Pairs:
    """Match elements by name, and those without a name in their order."""
    by_name = {name: index for index, name in here.items()}
    pairs = {index: by_name[name] for index, name in in_file.items() if name and name in by_name}
    rest = [index for index in here if index not in pairs.values()]
    unnamed = [index for index, name in in_file.items() if not name]
    return pairs | dict(zip(unnamed, rest, strict=False))


def some(names: list[str]) -> str:
    """The first three names, for a sentence."""
    return enumerated(names[:3], len(names))


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


def is_carrier(label: str) -> bool:
    """Whether the body with this label only carries a joint."""
    return CARRIER in short(label)


def empty_builder() -> newton.ModelBuilder:
    """A builder with the attributes of MuJoCo that importers and solver use."""
    builder = newton.ModelBuilder()
    SolverMuJoCo.register_custom_attributes(builder)
    return builder


def keep_inertias(builder: newton.ModelBuilder) -> None:
    """Let Newton leave moments of inertia as they are: MuJoCo's compiler judges them."""
    builder.balance_inertia = False
    builder.inertia_relative_tolerance = builder.inertia_correction = 0.0
    builder.inertia_absolute_tolerance = 1e-30  # Newton wants more than 0


def unload(model: newton.Model, solver: SolverMuJoCo) -> None:
    """Take the mass from the carriers of a model, after its solver was built."""
    count = model.body_count // model.world_count
    carriers = [index for index, label in enumerate(model.body_label[:count]) if is_carrier(label)]
    if not carriers:
        return
    bodies = (count * np.arange(model.world_count)[:, None] + carriers).ravel()
    arrays: tuple[Any, ...] = (model.body_mass, model.body_inv_mass, model.body_inertia, model.body_inv_inertia)
    for array in arrays:
        values = array.numpy()
        values[bodies] = 0.0
        array.assign(values)
    solver.notify_model_changed(newton.ModelFlags.BODY_INERTIAL_PROPERTIES)
