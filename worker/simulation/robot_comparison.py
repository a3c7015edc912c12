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
from worker.simulation.robot_elements import TARGETS, Ends, count_of, matrix, word_of
from worker.simulation.robot_fields import CONTACT, ELSEWHERE, ENDS, SHARED, VALUES, Values
from worker.simulation.robot_files import quiet
from worker.simulation.robot_twins import Twins
from worker.simulation.robot_values import freedoms, from_actuators, gravity, has_mask, length, shown_value

ROUNDING = 1e-4
"""Up to this share of the greater one, a difference is of no consequence to a policy."""
APART = ("type", "mocap", "contype", "conaffinity", "vertices", "middle")
"""Values that are compared in another way, or are part of an identity alone."""
FAR = 10.0
"""Ends of an equality are compared this much less sharply: their places add up along chains of bodies."""
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
        found = [*_counts(twins), *_values(twins, "body", "joint", "geom"), *_sites(twins), *_contacts(twins)]
        found += _values(twins, "pair", "tendon", "actuator", "equality")
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
    for geom in set(range(twins.file.ngeom)) - set(twins.geoms):
        if has_mask(twins.file, geom):
            yield RobotDifference(twins.name("geom", geom), "existence", "missing", "there")
        if _has_medium(twins.file):
            fluid = twins.file.geom_fluid[geom]
            yield from _unequal(twins.name("geom", geom), "fluid", 0.0 * fluid, fluid)
    for pair in range(twins.file.npair):
        if pair not in twins.contact_pairs:
            yield RobotDifference(f"contact pair {pair}", "existence", "missing", "there")


def _has_medium(model: Any) -> bool:
    return bool(model.opt.density or model.opt.viscosity)


def _values(twins: Twins, *kinds: str) -> Iterator[RobotDifference]:
    """The values of the elements that both models have."""
    size = length(twins.file)
    scales = {**dict.fromkeys(("pos", "centre of mass", "shape and place"), size), "orientation": 1.0, "inertia": 1e-15}
    scales |= dict.fromkeys(("anchor1", "anchor2", "turn"), FAR * max(1.0, size))
    shares = {name: from_actuators(twins.file, name) for name in SHARED}
    for kind in kinds:
        for index, twin in twins.pairs(kind).items():
            if kind == "body" and not index:
                continue  # the world
            element = f"contact pair {index}" if kind == "pair" else twins.name(kind, index)
            theirs, mine = VALUES[kind](twins.file, index), VALUES[kind](twins.stepped, twin)
            if mine.get("type") != theirs.get("type"):
                yield RobotDifference(element, "type", mine["type"], theirs["type"])
                continue
            _settle(twins, kind, index, twin, theirs, mine)
            for name in SHARED if kind in ("joint", "tendon") else ():
                first, last = index, index + 1
                if kind == "joint":
                    first = twins.file.jnt_dofadr[index]
                    last = first + freedoms(twins.file, index)
                share = shares[name][kind == "tendon"][first:last]
                theirs[name] = theirs[name] + (share if kind == "joint" else share[0])
            for name, value in theirs.items():
                if name in ENDS:
                    words = _words(twins, kind, index, twin, name, value)
                    yield from _ends(twins, element, words, twins.in_file(mine[name]), value)
                elif name in mine and name not in APART:
                    yield from _unequal(element, name, mine[name], value, scales.get(name, 0.0))


def _settle(twins: Twins, kind: str, index: int, twin: int, theirs: Values, mine: Values) -> None:
    """Let two elements have their values in the same form, without those that are noted or of no consequence."""
    file, built = twins.file, twins.stepped
    if kind == "body":  # with its first carrier's place
        root = (twins.carriers_of(twin) or [twin])[-1]
        mine |= {"pos": built.body_pos[root], "orientation": matrix(built.body_quat[root])}
        mine["parent"] = (("body", int(built.body_parentid[root])),)
    elif kind == "geom":
        mine |= {name: getattr(built, f"geom_{name}")[twin] for name in CONTACT.split()}
        if not _has_medium(file):
            del theirs["fluid"]
    elif kind == "pair":
        for values in (theirs, mine):  # two zeros stand for its solref
            if not values["solreffriction"].any():
                values["solreffriction"] = values["solref"]
    if "margin" in theirs and kind in ("geom", "pair") and lost_margin(twins, kind, index, twin):
        del theirs["margin"]


def _words(twins: Twins, kind: str, index: int, twin: int, name: str, ends: Ends) -> Sequence[str]:
    """The attributes that name the ends of an element; none for ends that are compared in another way."""
    if name == "drives" and twins.file.actuator_trntype[index] == twins.stepped.actuator_trntype[twin]:
        return TARGETS.get(word_of(mujoco.mjtTrn, twins.file.actuator_trntype[index]), ())
    if name == "between":
        return [f"{kind}{number}" for number, (kind, _) in enumerate(ends, 1)]
    return [f"path {number}" for number in range(len(ends))] if name == "path" else [name] if name == "parent" else []


def _sites(twins: Twins) -> Iterator[RobotDifference]:
    file = twins.file
    for site, shape in twins.sites.items():
        element = twins.name("site", site)
        if shape is None:
            yield RobotDifference(element, "existence", "missing", "there")
            continue
        pose: Any = twins.builder.shape_transform[shape]
        x, y, z, *turn = map(float, [*pose])
        yield from _unequal(element, "pos", (x, y, z), file.site_pos[site], length(file))
        orientation = matrix((turn[3], *turn[:3]))
        yield from _unequal(element, "orientation", orientation, matrix(file.site_quat[site]), 1.0)


def _contacts(twins: Twins) -> Iterator[RobotDifference]:
    words = {True: "can touch", False: "can't touch"}
    for pair, mine in differing(twins):
        if mine or not stay_apart(twins, pair):
            names = " and ".join(twins.name("geom", geom).removeprefix("geom ") for geom in pair)
            yield RobotDifference(f"geoms {names}", "contact", words[mine], words[not mine])


def _ends(
    twins: Twins, element: str, words: Sequence[str], in_muster: Ends, in_file: Ends
) -> Iterator[RobotDifference]:
    """The ends of an element that are others than in the file, by the attributes that name them."""
    for word, mine, theirs in zip(words, in_muster, in_file, strict=False):
        if mine != theirs:
            yield RobotDifference(element, word, twins.shown_end(mine), twins.shown_end(theirs))


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
