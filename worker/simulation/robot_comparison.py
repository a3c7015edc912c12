"""The comparison of a built robot with its file as MuJoCo compiles it: every value that differs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Any

import mujoco
import newton
import numpy as np

from worker.simulation.robot_behavior import RELATIVE, differing, dynamics, lost_margin, notes, stay_apart
from worker.simulation.robot_elements import (
    TARGETS,
    Ends,
    actuator_ends,
    count_of,
    equality_ends,
    held,
    matrix,
    tendon_ends,
    tendon_numbers,
    word_of,
)
from worker.simulation.robot_files import quiet
from worker.simulation.robot_twins import Twins
from worker.simulation.robot_values import (
    effort,
    extent,
    freedoms,
    from_actuators,
    gravity,
    has_mask,
    inertia,
    length,
    shown_value,
)

ROUNDING = 1e-4
"""Up to this share of the greater one, a difference is of no consequence to a policy."""
FAR = 10.0
"""Ends of an equality are compared this much less sharply: their places add up along chains of bodies."""
ELSEWHERE = (
    *("mjDSBL_MULTICCD", "mjENBL_SLEEP", "mjDSBL_SENSOR", "mjDSBL_GRAVITY", "mjENBL_ENERGY", "mjENBL_FWDINV"),
    *("mjDSBL_MIDPHASE", "mjDSBL_AUTORESET"),
)
"""Flags that a task's solver options set, that nothing here reads, that only report or speed up, or that are compared in another way."""
COUNTS = {
    "coordinates": "nq",
    "degrees of freedom": "nv",
    "actuators": "nu",
    "activations": "na",
    "tendons": "ntendon",
    "equalities": "neq",
    "contact pairs": "npair",
}
"""What is counted, and its field of ``mujoco.MjModel``."""
TENDON = (
    "num limited range actfrclimited actfrcrange margin stiffness stiffnesspoly frictionloss lengthspring "
    "solref_lim solimp_lim solref_fri solimp_fri length0"
)
ACTUATOR = (
    "trntype gear dyntype gaintype biastype gainprm biasprm ctrllimited forcelimited actlimited actnum actearly cranklength "
    "delay history"
)
"""Compared fields of ``mujoco.MjModel``, without their prefixes."""
SHARED = ("damping", "dampingpoly", "armature")
"""Those of joints and tendons to which actuators add."""


@dataclass(frozen=True)
class RobotDifference:
    """One value that the built robot has otherwise than its file.

    Attributes:
        element: Kind and name of the element in the file: ``"joint knee"``.
        field: Name of the value, as in MJCF where it has one.
        built: Value in the built robot.
        file: Value in the file, as MuJoCo compiles it.
    """

    element: str
    field: str
    built: Any
    file: Any

    @property
    def is_rounding(self) -> bool:
        """Whether the values are equal but for the last of a float's digits, so that no policy would notice."""
        built, file = (
            None if isinstance(value, str | bool) else np.asarray(value, np.float64)
            for value in (self.built, self.file)
        )
        if built is None or file is None or built.shape != file.shape:
            return False
        return bool(np.allclose(built, file, rtol=0.0, atol=ROUNDING * np.abs(file).max(initial=0.0)))

    def __str__(self) -> str:
        return f"{self.element}: {self.field} is {shown_value(self.built)}, in the file {shown_value(self.file)}"


@dataclass(frozen=True)
class Comparison:
    """A robot as built, compared with its file.

    Attributes:
        differences: Empty where the robot is what its file says.
        notes: What contacts have otherwise, which Newton or MuJoCo-Warp can't hold, one sentence each.
        bodies: Index of each body of the file among the builder's bodies.
        sliders: Indices of the builder's bodies that only slide.
        accepted: Differences that do not count.
    """

    differences: tuple[RobotDifference, ...]
    notes: tuple[str, ...]
    bodies: dict[int, int]
    sliders: tuple[int, ...] = ()
    accepted: tuple[RobotDifference, ...] = ()


def compare(
    reference: Any, builder: newton.ModelBuilder, *, options: bool = True, accept: Sequence[str] = ()
) -> Comparison:
    """Compare a builder of one robot with the robot's file.

    Args:
        reference: The file's compiled model, ``mujoco.MjModel``.
        builder: Holds the robot alone, as imported.
        options: Whether gravity, the medium and the flags of the file's options count.
        accept: Patterns of differences that do not count, ``"ELEMENT: FIELD"``. Where one does not, accelerations are not compared.
    """
    with quiet():
        twins = Twins(reference, builder)
        found = [difference for check in CHECKS for difference in check(twins)]
        found += _options(twins) if options else ()
        found = found or [RobotDifference(*each) for each in dynamics(twins, options)]
        counting = [each for each in found if not matches(each, accept)]
        accepted = tuple(each for each in found if matches(each, accept))
        bodies = {body: twins.body_indices[twin] for body, twin in twins.bodies.items() if body}
        return Comparison(tuple(counting), tuple(notes(twins)), bodies, tuple(twins.sliders), accepted)


def matches(difference: RobotDifference, patterns: Sequence[str]) -> bool:
    return any(fnmatchcase(f"{difference.element}: {difference.field}", pattern) for pattern in patterns)


def _counts(twins: Twins) -> Iterator[RobotDifference]:
    kinds = {"body": twins.bodies, "joint": twins.joints, "tendon": twins.tendons, "equality": twins.equalities}
    for kind, pairs in kinds.items():
        for index in range(count_of(twins.file, kind)):
            if index not in pairs:
                yield RobotDifference(twins.name(kind, index), "existence", "missing", "there")
    for what, field in COUNTS.items():
        if getattr(twins.built, field) != getattr(twins.file, field):
            yield RobotDifference(
                "model", f"the number of {what}", getattr(twins.built, field), getattr(twins.file, field)
            )
    for flex in range(twins.file.nflex):
        yield RobotDifference(twins.name("flex", flex), "flexible body", "missing", "there")
    for kind in ("body", "geom", "actuator"):  # what else has plugins is not read
        for index in (getattr(twins.file, f"{kind}_plugin") >= 0).nonzero()[0]:
            yield RobotDifference(twins.name(kind, index), "plugin", "missing", "there")


def _bodies(twins: Twins) -> Iterator[RobotDifference]:
    file, built, size = twins.file, twins.stepped, length(twins.file)
    for body, twin in twins.bodies.items():
        if not body:
            continue
        element, root = twins.name("body", body), (twins.carriers_of(twin) or [twin])[-1]
        parent, above = int(file.body_parentid[body]), int(built.body_parentid[root])
        if twins.bodies.get(parent) != above:
            yield RobotDifference(element, "parent", twins.built_body(above), twins.name("body", parent))
        yield from _fields(twins, "body", body, twin, "mass gravcomp")
        if file.body_mass[body]:
            yield from _unequal(element, "inertia", inertia(built, twin), inertia(file, body), 1e-15)
            yield from _unequal(element, "centre of mass", built.body_ipos[twin], file.body_ipos[body], size)
        yield from _unequal(element, "pos", built.body_pos[root], file.body_pos[body], size)
        yield from _unequal(element, "orientation", matrix(built.body_quat[root]), matrix(file.body_quat[body]), 1.0)


def _joints(twins: Twins) -> Iterator[RobotDifference]:
    file, built = twins.file, twins.stepped
    shares = {name: from_actuators(file, name)[0] for name in SHARED}
    for joint, twin in twins.joints.items():
        element = twins.name("joint", joint)
        kind, other = (word_of(mujoco.mjtJoint, model.jnt_type[each]) for model, each in ((file, joint), (built, twin)))
        if kind != other:
            yield RobotDifference(element, "type", other, kind)
            continue
        if kind != "free":
            yield from _unequal(element, "pos", built.jnt_pos[twin], file.jnt_pos[joint], length(file))
        if kind in ("hinge", "slide"):
            yield from _fields(twins, "jnt", joint, twin, "axis")
            first, second = file.jnt_qposadr[joint], built.jnt_qposadr[twin]
            yield from _unequal(element, "ref", built.qpos0[second], file.qpos0[first])
            yield from _unequal(element, "springref", built.qpos_spring[second], file.qpos_spring[first])
        yield from _fields(twins, "jnt", joint, twin, "stiffness stiffnesspoly limited actgravcomp")
        if file.jnt_limited[joint] and built.jnt_limited[twin]:
            yield from _fields(twins, "jnt", joint, twin, "range margin solref solimp")
        yield from _unequal(element, "actuatorfrcrange", effort(built, twin), effort(file, joint))
        first, second = file.jnt_dofadr[joint], built.jnt_dofadr[twin]
        for name in (*SHARED, "frictionloss", "solref", "solimp"):
            count = freedoms(file, joint)
            if name not in ("solref", "solimp") or file.dof_frictionloss[first]:
                mine, theirs = getattr(built, f"dof_{name}"), getattr(file, f"dof_{name}") + shares.get(name, 0.0)
                word = f"{name}friction" if name.startswith("sol") else name
                yield from _unequal(element, word, mine[second : second + count], theirs[first : first + count])


def _geoms(twins: Twins) -> Iterator[RobotDifference]:
    file, built = twins.file, twins.stepped
    has_medium = bool(file.opt.density or file.opt.viscosity)
    for geom in set(range(file.ngeom)) - set(twins.geoms):
        if has_mask(file, geom):
            yield RobotDifference(twins.name("geom", geom), "existence", "missing", "there")
        if has_medium:
            yield from _unequal(twins.name("geom", geom), "fluid", 0.0 * file.geom_fluid[geom], file.geom_fluid[geom])
    for geom, twin in twins.geoms.items():
        element = twins.name("geom", geom)
        kind, other = (word_of(mujoco.mjtGeom, model.geom_type[each]) for model, each in ((file, geom), (built, twin)))
        if kind != other:
            yield RobotDifference(element, "type", other, kind)
            continue
        if has_mask(file, geom):
            yield from _fields(twins, "geom", geom, twin, "condim friction solref solimp solmix priority gap")
            if not lost_margin(twins, "geom", geom, twin):
                yield from _fields(twins, "geom", geom, twin, "margin")
        if has_medium:
            yield from _fields(twins, "geom", geom, twin, "fluid")
        yield from _unequal(element, "shape and place", extent(built, twin), extent(file, geom), length(file))


def _sites(twins: Twins) -> Iterator[RobotDifference]:
    file = twins.file
    for site, shape in twins.sites.items():
        element = twins.name("site", site)
        if shape is None:
            yield RobotDifference(element, "existence", "missing", "there")
            continue
        position, turn = twins.built_site(shape)
        yield from _unequal(element, "pos", position, file.site_pos[site], length(file))
        yield from _unequal(element, "orientation", matrix(turn), matrix(file.site_quat[site]), 1.0)


def _pairs(twins: Twins) -> Iterator[RobotDifference]:
    for pair in range(twins.file.npair):
        element = f"contact pair {pair}"
        if pair not in twins.contact_pairs:
            yield RobotDifference(element, "existence", "missing", "there")
            continue
        twin = twins.contact_pairs[pair]
        models = (twins.stepped, twin), (twins.file, pair)
        for name in ("dim", "friction", "solref", "solimp", "margin", "gap"):
            mine, theirs = (getattr(model, f"pair_{name}")[index] for model, index in models)
            if name != "margin" or not lost_margin(twins, "pair", pair, twin):
                yield from _unequal(element, name, mine, theirs)
        mine, theirs = (_of_friction(model, index) for model, index in models)
        yield from _unequal(element, "solreffriction", mine, theirs)


def _of_friction(model: Any, pair: int) -> Any:
    """A pair's ``solreffriction``, which is its ``solref`` where it is two zeros."""
    found = model.pair_solreffriction[pair]
    return found if found.any() else model.pair_solref[pair]


def _contacts(twins: Twins) -> Iterator[RobotDifference]:
    words = {True: "can touch", False: "can't touch"}
    for pair, mine in differing(twins):
        if mine or not stay_apart(twins, pair):
            names = " and ".join(twins.name("geom", geom).removeprefix("geom ") for geom in pair)
            yield RobotDifference(f"geoms {names}", "contact", words[mine], words[not mine])


def _tendons(twins: Twins) -> Iterator[RobotDifference]:
    shares = {name: from_actuators(twins.file, name)[1] for name in SHARED}
    for tendon, twin in twins.tendons.items():
        yield from _fields(twins, "tendon", tendon, twin, TENDON)
        for name, share in shares.items():
            mine, theirs = getattr(twins.stepped, f"tendon_{name}"), getattr(twins.file, f"tendon_{name}") + share
            yield from _unequal(twins.name("tendon", tendon), name, mine[twin], theirs[tendon])
        there, here = tendon_ends(twins.file, tendon), twins.in_file(tendon_ends(twins.stepped, twin))
        element, mine, theirs = (
            twins.name("tendon", tendon),
            *(tendon_numbers(model, index) for model, index in ((twins.stepped, twin), (twins.file, tendon))),
        )
        yield from _ends(twins, element, [f"path {index}" for index in range(len(there))], here, there)
        yield from _unequal(element, "coefficients", mine, theirs)


def _ends(twins: Twins, element: str, words: Sequence[str], here: Ends, there: Ends) -> Iterator[RobotDifference]:
    """The ends of an element that are others than in the file, by the attributes that name them."""
    for word, mine, theirs in zip(words, here, there, strict=False):
        if mine != theirs:
            yield RobotDifference(element, word, twins.shown_end(mine), twins.shown_end(theirs))


def _actuators(twins: Twins) -> Iterator[RobotDifference]:
    file, built = twins.file, twins.stepped
    for actuator in range(min(file.nu, built.nu)):
        yield from _fields(twins, "actuator", actuator, actuator, ACTUATOR)
        for limit in ("ctrl", "force", "act"):
            limited = f"actuator_{limit}limited"
            if getattr(file, limited)[actuator] and getattr(built, limited)[actuator]:
                yield from _fields(twins, "actuator", actuator, actuator, f"{limit}range")
        if file.actuator_dyntype[actuator]:
            yield from _fields(twins, "actuator", actuator, actuator, "dynprm lengthrange")
        if file.actuator_trntype[actuator] == built.actuator_trntype[actuator]:
            words = TARGETS.get(word_of(mujoco.mjtTrn, file.actuator_trntype[actuator]), ())
            here, there = twins.in_file(actuator_ends(built, actuator)), actuator_ends(file, actuator)
            yield from _ends(twins, twins.name("actuator", actuator), words, here, there)


def _equalities(twins: Twins) -> Iterator[RobotDifference]:
    file, built = twins.file, twins.stepped
    for equality, twin in twins.equalities.items():
        element = twins.name("equality", equality)
        yield from _fields(twins, "eq", equality, twin, "active0 solref solimp")
        here, there = twins.in_file(equality_ends(built, twin)), equality_ends(file, equality)
        yield from _ends(twins, element, [f"{kind}{number}" for number, (kind, _) in enumerate(there, 1)], here, there)
        mine = held(built, twin)
        for name, theirs in held(file, equality).items():
            scale = {"polycoef": 0.0, "torquescale": 0.0}.get(name, FAR * max(1.0, length(file)))
            yield from _unequal(element, name, mine[name], theirs, scale)


def _options(twins: Twins) -> Iterator[RobotDifference]:
    file, built = twins.file.opt, twins.built.opt
    yield from _unequal("option", "gravity", gravity(twins.built), gravity(twins.file))
    for name in ("wind", "density", "viscosity", "impratio", "cone", "disableactuator"):
        yield from _unequal("option", name, getattr(built, name), getattr(file, name))
    for kind, name in ((mujoco.mjtDisableBit, "disableflags"), (mujoco.mjtEnableBit, "enableflags")):
        mine, theirs = int(getattr(built, name)), int(getattr(file, name))
        for bit in kind.__members__.values():
            if not bit.name.startswith("mjN") and bit.name not in ELSEWHERE and (mine ^ theirs) & int(bit):
                word = bit.name.partition("_")[2].lower()
                yield RobotDifference("option", f"{name} {word}", bool(mine & int(bit)), bool(theirs & int(bit)))


def _fields(twins: Twins, kind: str, index: int, twin: int, names: str) -> Iterator[RobotDifference]:
    element = twins.name({"jnt": "joint", "eq": "equality"}.get(kind, kind), index)
    for name in names.split():
        field = f"{kind}_{name}"
        yield from _unequal(element, name, getattr(twins.stepped, field)[twin], getattr(twins.file, field)[index])


def _unequal(element: str, field: str, built: Any, file: Any, scale: float = 0.0) -> Iterator[RobotDifference]:
    mine, theirs = (np.clip(np.asarray(value, np.float64), -newton.MAXVAL, newton.MAXVAL) for value in (built, file))
    if mine.shape != theirs.shape:
        yield RobotDifference(element, field, built, file)
        return
    bounded = (mine != theirs) | (np.abs(mine) < newton.MAXVAL)  # of the open end of a range, nothing is to be compared
    mine, theirs = mine[bounded], theirs[bounded]
    greatest = max(scale, float(np.abs(theirs).max(initial=0.0)), float(np.abs(mine).max(initial=0.0)))
    if not (np.abs(mine - theirs) <= RELATIVE * greatest).all():
        yield RobotDifference(element, field, built, file)


CHECKS = (_counts, _bodies, _joints, _geoms, _sites, _contacts, _pairs, _tendons, _actuators, _equalities)
