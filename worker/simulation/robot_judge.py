"""What differs between a robot's file as MuJoCo compiles it and the robot that Newton's importer built."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Any

import mujoco
import newton
import numpy as np
from newton.solvers import SolverMuJoCo

from worker.simulation import carriers
from worker.simulation.robot_mjcf import name_of
from worker.simulation.robot_view import dof_names

RELATIVE = 1e-6
"""Two values are equal up to this share of the greater one: Newton computes in float32."""
UNLIMITED = 1e6
"""Newton's effort limit of joints whose file sets none [N, N m]."""
ACCELERATION = 1e-3
"""Accelerations in the same state are equal up to this share of the greatest one."""

CHOSEN_HERE = ("mjDSBL_MULTICCD", "mjENBL_SLEEP", "mjDSBL_SENSOR", "mjDSBL_GRAVITY")
"""Flags that a task's solver options set, that nothing here reads, or that are compared in another way."""

Pairs = dict[int, int]
"""Index of an element in the built model, by its index in the reference."""


@dataclass(frozen=True)
class Difference:
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

    def __str__(self) -> str:
        return f"{self.element}: {self.field} is {_shown(self.built)}, in the file {_shown(self.file)}"


@dataclass(frozen=True)
class Comparison:
    """A robot as built, compared with its file.

    Attributes:
        differences: Empty where the robot is what its file says.
        notes: What contacts have otherwise, which Newton can't hold, one sentence each.
        bodies: Index of each body of the file among the builder's bodies.
    """

    differences: tuple[Difference, ...]
    notes: tuple[str, ...]
    bodies: dict[int, int]


def plain(name: str) -> str:
    """A name as Newton's importer keeps it: other characters than letters, digits and underscores become underscores."""
    return re.sub(r"\W", "_", name)


def compare(
    reference: Any, builder: newton.ModelBuilder, *, options: bool = True, accept: Sequence[str] = ()
) -> Comparison:
    """Compare a builder of one robot with the robot's file.

    Args:
        reference: The file's compiled model, ``mujoco.MjModel``.
        builder: Holds the robot alone, as imported.
        options: Whether gravity, the medium and the flags of the file's options count.
        accept: Patterns of differences that do not count, ``"ELEMENT: FIELD"``. With one that does not, accelerations are not compared.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of values that are compared here
        judge = Judge(reference, builder, options)
        found = [*judge.of_fields()]
        counting = [each for each in found if not _is_accepted(each, accept)]
        if not found:
            counting = [*judge.of_accelerations()]
    return Comparison(tuple(counting), judge.notes(), judge.body_indices())


def _is_accepted(difference: Difference, accept: Sequence[str]) -> bool:
    return any(fnmatchcase(f"{difference.element}: {difference.field}", pattern) for pattern in accept)


class Judge:
    """Both models of one robot: the file's, and the one that its builder becomes.

    Attributes:
        there: The file's compiled model, ``mujoco.MjModel``.
        here: The built robot's, ``mujoco.MjModel``.
    """

    def __init__(self, reference: Any, builder: newton.ModelBuilder, options: bool) -> None:
        self.there, self.builder, self.options = reference, builder, options
        model = finalized(builder)
        solver = SolverMuJoCo(
            model, use_mujoco_cpu=True, separate_worlds=False, kinematic_switchable_roots=False, disable_sensors=True
        )
        carriers.unload(model, solver)
        self.here = solver.mj_model
        self.bodies = _index(solver.mjc_body_to_newton)
        self.dofs = _index(solver.mjc_jnt_to_newton_dof)
        self.shapes = _index(solver.mjc_geom_to_newton_shape)
        self.without_margin: list[str] = []
        self.apart: list[str] = []

    def notes(self) -> tuple[str, ...]:
        """What is told apart from the differences: a robot moves as its file says without it."""
        notes = []
        if self.without_margin:
            notes.append(
                f"contacts begin where geoms touch, not at the margin of the file (geoms {_some(self.without_margin)}): MuJoCo-Warp "
                "has no margins between boxes"
            )
        if self.apart:
            notes.append(f"what a joint or an equality connects does not touch each other, not even a base that is fixed to the world ({_some(self.apart)})")
        return tuple(notes)

    def body_indices(self) -> dict[int, int]:
        return {there: self.bodies[here] for there, here in self._pair_bodies().items() if there}

    def of_fields(self) -> Iterator[Difference]:
        bodies = self._pair_bodies()
        joints = self.pair_joints()
        geoms = self._pair_geoms(bodies)
        yield from self._counts(bodies, joints)
        yield from self._of_bodies(bodies)
        yield from self._of_joints(joints)
        yield from self._of_geoms(geoms)
        yield from self._of_contacts(geoms)
        yield from self._of_tendons()
        yield from self._of_actuators(joints)
        yield from self._of_equalities()
        if self.options:
            yield from self._of_options()

    # -- which element is which

    def _pair_bodies(self) -> Pairs:
        names = {}
        for index, body in enumerate(self.bodies):
            if body >= 0 and not carriers.is_carrier(self.builder.body_label[body]):
                names[index] = plain(_short(self.builder.body_label[body]))
        return {0: 0} | _pair(_names(self.there, "body", range(1, self.there.nbody)), names)

    def pair_joints(self) -> Pairs:
        names = {index: plain(self._joint_name(dof)) for index, dof in enumerate(self.dofs)}
        return _pair(_names(self.there, "joint", range(self.there.njnt)), names)

    def _joint_name(self, dof: int) -> str:
        starts = self.builder.joint_qd_start
        joint = max(index for index, start in enumerate(starts[: self.builder.joint_count]) if start <= dof)
        if self.builder.joint_type[joint] in (newton.JointType.FREE, newton.JointType.BALL):
            return _short(self.builder.joint_label[joint])
        return dof_names(self.builder, joint)[dof - starts[joint]]

    def _pair_geoms(self, bodies: Pairs) -> Pairs:
        """Geoms that can touch: Newton leaves out those that are only seen."""
        model = self.there
        explicit = {*model.pair_geom1.tolist(), *model.pair_geom2.tolist()}
        can = [geom for geom in range(model.ngeom) if model.geom_contype[geom] or model.geom_conaffinity[geom] or geom in explicit]
        pairs: Pairs = {}
        for there, here in bodies.items():
            mine = _names(model, "geom", [geom for geom in can if model.geom_bodyid[geom] == there])
            built = {
                geom: plain(_short(self.builder.shape_label[shape]))
                for geom, shape in enumerate(self.shapes)
                if self.here.geom_bodyid[geom] == here and (self.here.geom_contype[geom] or self.here.geom_conaffinity[geom])
            }
            pairs |= _pair(mine, built)
        return pairs

    def _by_name(self, kind: str) -> Pairs:
        """Elements by their names, whether the file gives them or not, and the others in their order."""
        count = {"tendon": "ntendon", "equality": "neq"}[kind]
        there, here = ({index: plain(_short(name_of(model, _kind(kind), index))) for index in range(getattr(model, count))} for model in (self.there, self.here))
        pairs = _pair(there, here)
        rest = ([index for index in each if index not in taken] for each, taken in ((there, pairs), (here, set(pairs.values()))))
        return pairs | dict(zip(*rest, strict=False))

    # -- differences

    def _counts(self, bodies: Pairs, joints: Pairs) -> Iterator[Difference]:
        there, here = self.there, self.here
        for kind, pairs, count in (("body", bodies, there.nbody), ("joint", joints, there.njnt)):
            for index in range(count):
                if index not in pairs:
                    yield Difference(f"{kind} {name_of(there, _kind(kind), index)}", "existence", "missing", "there")
        for name, field in (("coordinates", "nq"), ("degrees of freedom", "nv"), ("actuators", "nu"), ("activations", "na"), ("tendons", "ntendon"), ("equalities", "neq"), ("contact pairs", "npair")):
            if getattr(here, field) != getattr(there, field):
                yield Difference("model", f"the number of {name}", getattr(here, field), getattr(there, field))

    def _of_bodies(self, bodies: Pairs) -> Iterator[Difference]:
        for there, here in bodies.items():
            if not there:
                continue
            element = self._element("body", there)
            carried = [self._carried(here)] if self._carried(here) else []
            root = carried[0][-1] if carried else here
            parent = bodies.get(int(self.there.body_parentid[there]))
            if parent != int(self.here.body_parentid[root]):
                yield Difference(element, "parent", self._body_here(int(self.here.body_parentid[root])), name_of(self.there, _kind("body"), int(self.there.body_parentid[there])))
            yield from self._fields(element, "body", there, here, "mass gravcomp")
            scale = max(1e-15, float(np.abs(self.there.body_inertia[there]).max()))
            yield from _unequal(element, "inertia", inertia(self.here, here), inertia(self.there, there), scale)
            if self.there.body_mass[there]:
                yield from _unequal(element, "centre of mass", self.here.body_ipos[here], self.there.body_ipos[there], _length(self.there))
            yield from _unequal(element, "pos", self.here.body_pos[root], self.there.body_pos[there], _length(self.there))
            yield from _unequal(element, "orientation", _matrix(self.here.body_quat[root]), _matrix(self.there.body_quat[there]), 1.0)

    def _of_joints(self, joints: Pairs) -> Iterator[Difference]:
        there, here = self.there, self.here
        for old, new in joints.items():
            element = self._element("joint", old)
            if there.jnt_type[old] != here.jnt_type[new]:
                yield Difference(element, "type", _word(mujoco.mjtJoint, here.jnt_type[new]), _word(mujoco.mjtJoint, there.jnt_type[old]))
                continue
            free = there.jnt_type[old] == int(mujoco.mjtJoint.mjJNT_FREE)
            ball = there.jnt_type[old] == int(mujoco.mjtJoint.mjJNT_BALL)
            if not free:
                yield from _unequal(element, "pos", here.jnt_pos[new], there.jnt_pos[old], _length(there))
            if not free and not ball:
                yield from self._fields(element, "jnt", old, new, "axis")
                for name, array in (("ref", "qpos0"), ("springref", "qpos_spring")):
                    yield from _unequal(element, name, getattr(here, array)[here.jnt_qposadr[new]], getattr(there, array)[there.jnt_qposadr[old]])
            yield from self._fields(element, "jnt", old, new, "stiffness stiffnesspoly limited actgravcomp")
            if there.jnt_limited[old] and here.jnt_limited[new]:
                yield from self._fields(element, "jnt", old, new, "range margin solref solimp")
            yield from _unequal(element, "actuatorfrcrange", _effort(here, new), _effort(there, old))
            count = 6 if free else 3 if ball else 1
            for offset in range(count):
                first, second = there.jnt_dofadr[old] + offset, here.jnt_dofadr[new] + offset
                loss = "solref solimp" if there.dof_frictionloss[first] else ""
                yield from self._fields(element, "dof", first, second, f"damping dampingpoly armature frictionloss {loss}")

    def _of_geoms(self, geoms: Pairs) -> Iterator[Difference]:
        there, here = self.there, self.here
        for geom in range(there.ngeom):
            if geom not in geoms and (there.geom_contype[geom] or there.geom_conaffinity[geom]):
                yield Difference(self._element("geom", geom), "existence", "missing", "there")
        for old, new in geoms.items():
            element = self._element("geom", old)
            if there.geom_type[old] != here.geom_type[new]:
                yield Difference(element, "type", _word(mujoco.mjtGeom, here.geom_type[new]), _word(mujoco.mjtGeom, there.geom_type[old]))
                continue
            yield from self._fields(element, "geom", old, new, "condim friction solref solimp solmix priority gap fluid")
            if there.geom_margin[old] and not here.geom_margin[new]:
                self.without_margin.append(name_of(there, _kind("geom"), old))
            else:
                yield from self._fields(element, "geom", old, new, "margin")
            yield from _unequal(element, "shape and place", _extent(here, new), _extent(there, old), _length(there))

    def _of_contacts(self, geoms: Pairs) -> Iterator[Difference]:
        old, new = list(geoms), list(geoms.values())
        theirs, mine = _touching(self.there)[np.ix_(old, old)], _touching(self.here)[np.ix_(new, new)]
        words = {True: "can touch", False: "can't touch"}
        welded = self.there.body_weldid[self.there.geom_bodyid]
        joined = self._joined()
        for first, second in np.argwhere(np.triu(theirs != mine)):
            ends = frozenset((int(welded[old[first]]), int(welded[old[second]])))
            if ends == {0}:
                continue  # neither can move
            names = " and ".join(name_of(self.there, _kind("geom"), old[each]) for each in (first, second))
            if theirs[first, second] and (0 in ends or ends in joined):
                self.apart.append(names)
            else:
                here, there = words[bool(mine[first, second])], words[bool(theirs[first, second])]
                yield Difference(f"geoms {names}", "contact", here, there)

    def _joined(self) -> set[frozenset[int]]:
        """Pairs of bodies that an equality joins, by what they are welded to."""
        model, weld = self.there, self.there.body_weldid
        joined = set()
        for equality in range(model.neq):
            kind, ends = model.eq_objtype[equality], (model.eq_obj1id[equality], model.eq_obj2id[equality])
            if kind == int(mujoco.mjtObj.mjOBJ_SITE):
                ends = tuple(model.site_bodyid[list(ends)])
            if kind in (int(mujoco.mjtObj.mjOBJ_SITE), int(mujoco.mjtObj.mjOBJ_BODY)):
                joined.add(frozenset(int(weld[end]) for end in ends))
        return joined

    def _of_tendons(self) -> Iterator[Difference]:
        for old, new in self._by_name("tendon").items():
            yield from self._fields(
                self._element("tendon", old),
                "tendon",
                old,
                new,
                "num limited range actfrclimited actfrcrange margin stiffness stiffnesspoly damping dampingpoly armature "
                "frictionloss lengthspring solref_lim solimp_lim solref_fri solimp_fri length0",
            )

    def _of_actuators(self, joints: Pairs) -> Iterator[Difference]:
        there, here = self.there, self.here
        joint_like = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
        for actuator in range(min(there.nu, here.nu)):
            element = self._element("actuator", actuator)
            yield from self._fields(
                element,
                "actuator",
                actuator,
                actuator,
                "trntype gear dyntype gaintype biastype gainprm biasprm ctrllimited forcelimited actlimited actnum actearly "
                "cranklength delay history damping dampingpoly armature",
            )
            for limit in ("ctrl", "force", "act"):
                if getattr(there, f"actuator_{limit}limited")[actuator] and getattr(here, f"actuator_{limit}limited")[actuator]:
                    yield from self._fields(element, "actuator", actuator, actuator, f"{limit}range")
            if there.actuator_dyntype[actuator]:
                yield from self._fields(element, "actuator", actuator, actuator, "dynprm lengthrange")
            if there.actuator_trntype[actuator] in joint_like and there.actuator_trntype[actuator] == here.actuator_trntype[actuator]:
                target, built = int(there.actuator_trnid[actuator, 0]), int(here.actuator_trnid[actuator, 0])
                if joints.get(target) != built:
                    yield Difference(element, "joint", self._joint_name(int(self.dofs[built])), name_of(there, _kind("joint"), target))

    def _of_equalities(self) -> Iterator[Difference]:
        for old, new in self._by_name("equality").items():
            yield from self._fields(self._element("equality", old), "eq", old, new, "type active0 solref solimp")

    def _of_options(self) -> Iterator[Difference]:
        yield from _unequal("option", "gravity", gravity(self.here), gravity(self.there))
        for name in "wind magnetic density viscosity impratio cone".split():
            yield from _unequal("option", name, getattr(self.here.opt, name), getattr(self.there.opt, name))
        for kind, name in ((mujoco.mjtDisableBit, "disableflags"), (mujoco.mjtEnableBit, "enableflags")):
            mine, theirs = int(getattr(self.here.opt, name)), int(getattr(self.there.opt, name))
            for bit in kind.__members__.values():
                if not bit.name.startswith("mjN") and bit.name not in CHOSEN_HERE and (mine ^ theirs) & int(bit):
                    word = bit.name.partition("_")[2].lower()
                    yield Difference("option", f"flag {word} ({name})", bool(mine & int(bit)), bool(theirs & int(bit)))

    def of_accelerations(self) -> Iterator[Difference]:
        """What no field shows: the accelerations in three states, without contacts."""
        joints = self.pair_joints()
        random = np.random.default_rng(0)
        there, here = _without_contacts(self.there), _without_contacts(self.here)
        here.opt.gravity, here.opt.timestep = gravity(there), there.opt.timestep
        for trial in range(3):
            first, second = mujoco.MjData(there), mujoco.MjData(here)
            for old, new in joints.items():
                _set_joint(first, second, there, here, old, new, 0.1 * trial, random)
            first.ctrl[:] = second.ctrl[:] = random.uniform(-0.5, 0.5, there.nu)
            if there.na == here.na:
                first.act[:] = second.act[:] = random.uniform(0.0, 0.5, there.na)
            mujoco.mj_forward(there, first)
            mujoco.mj_forward(here, second)
            scale = max(1.0, float(np.abs(first.qacc).max(initial=0.0)))
            for old, new in joints.items():
                dof, built = there.jnt_dofadr[old], here.jnt_dofadr[new]
                if not abs(first.qacc[dof] - second.qacc[built]) <= ACCELERATION * scale:
                    yield Difference(self._element("joint", old), "acceleration in the same state", second.qacc[built], first.qacc[dof])
                    return

    # -- values

    def _element(self, kind: str, index: int) -> str:
        return f"{kind} {name_of(self.there, _kind(kind), int(index))}"

    def _body_here(self, index: int) -> str:
        return _short(self.builder.body_label[self.bodies[index]]) if index else "world"

    def _carried(self, body: int) -> list[int]:
        """The bodies that carry the other joints of a body, from the nearest on."""
        above = []
        parent = int(self.here.body_parentid[body])
        while parent and carriers.is_carrier(self._body_here(parent)):
            above.append(parent)
            parent = int(self.here.body_parentid[parent])
        return above

    def _fields(self, element: str, kind: str, there: int, here: int, names: str) -> Iterator[Difference]:
        for name in names.split():
            array = f"{kind}_{name}"
            yield from _unequal(element, name, getattr(self.here, array)[here], getattr(self.there, array)[there])


def gravity(model: Any) -> Any:
    """Acceleration by gravity, 0 where the file disables it [m/s^2], shape ``(3,)``."""
    return model.opt.gravity * (not model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_GRAVITY))


def finalized(builder: newton.ModelBuilder) -> newton.Model:
    gaps = builder.shape_gap
    builder.shape_gap = [0.0 if gap == builder.rigid_gap else gap for gap in gaps]
    try:
        return builder.finalize(device="cpu")
    finally:
        builder.shape_gap = gaps


def _index(array: Any) -> list[int]:
    return [int(each) for each in array.numpy()[0]]


def _kind(word: str) -> mujoco.mjtObj:
    return getattr(mujoco.mjtObj, f"mjOBJ_{word.upper()}")


def _word(kind: Any, value: int) -> str:
    return kind(int(value)).name.rpartition("_")[2].lower()


def _names(model: Any, kind: str, indices: Sequence[int] | range) -> dict[int, str]:
    return {index: plain(mujoco.mj_id2name(model, _kind(kind), index) or "") for index in indices}


def _pair(there: dict[int, str], here: dict[int, str]) -> Pairs:
    """Match elements by name, and those without a name in their order."""
    by_name = {name: index for index, name in here.items()}
    pairs = {index: by_name[name] for index, name in there.items() if name and name in by_name}
    rest = [index for index in here if index not in pairs.values()]
    unnamed = [index for index, name in there.items() if not name]
    return pairs | dict(zip(unnamed, rest, strict=False))


def _some(names: list[str]) -> str:
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")


def _short(label: str) -> str:
    return label.rpartition("/")[2]


def _unequal(element: str, field: str, here: Any, there: Any, scale: float = 0.0) -> Iterator[Difference]:
    mine, theirs = np.asarray(here, np.float64), np.asarray(there, np.float64)
    if mine.shape != theirs.shape:
        yield Difference(element, field, here, there)
        return
    greatest = max(scale, float(np.abs(theirs).max(initial=0.0)), float(np.abs(mine).max(initial=0.0)))
    if not (np.abs(mine - theirs) <= RELATIVE * greatest).all():
        yield Difference(element, field, here, there)


def _shown(value: Any) -> str:
    if isinstance(value, str | bool | np.bool_):
        return str(value)
    numbers = np.atleast_1d(value).ravel()
    text = " ".join(f"{number:.6g}" for number in numbers[:9])
    return f"({text})" if len(numbers) > 1 else text


def _length(model: Any) -> float:
    """Size of the robot [m], to which differences of places are compared."""
    return float(max(model.stat.extent, 1e-3))


def _matrix(quaternion: Any) -> Any:
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, np.asarray(quaternion, np.float64))
    return matrix.reshape(3, 3)


def inertia(model: Any, body: int) -> Any:
    """Moments of inertia about the centre of mass in the body's own frame, shape (3, 3) [kg m^2]."""
    rotation = _matrix(model.body_iquat[body])
    return rotation @ np.diag(model.body_inertia[body]) @ rotation.T


def _effort(model: Any, joint: int) -> Any:
    lower, upper = model.jnt_actfrcrange[joint]
    limited = model.jnt_actfrclimited[joint] and max(-lower, upper) < UNLIMITED
    return (lower, upper) if limited else (0.0, 0.0)


def _extent(model: Any, geom: int) -> Any:
    """A geom's size and pose as numbers that do not depend on how its frame is chosen, in its body's frame [m]."""
    position, matrix, size = model.geom_pos[geom], _matrix(model.geom_quat[geom]), model.geom_size[geom]
    kind = _word(mujoco.mjtGeom, model.geom_type[geom])
    if kind == "mesh":
        mesh = model.geom_dataid[geom]
        first, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
        points = position + model.mesh_vert[first : first + count] @ matrix.T
        return np.array([points.min(0), points.max(0)])
    if kind == "hfield":
        field = model.geom_dataid[geom]
        first, count = model.hfield_adr[field], model.hfield_nrow[field] * model.hfield_ncol[field]
        return np.concatenate([position, matrix.ravel(), model.hfield_size[field], model.hfield_data[first : first + count]])
    if kind == "plane":
        return np.array([position - matrix[:, 2] * (position @ matrix[:, 2]), matrix[:, 2]])[1:]
    axes = {"sphere": (size[0],) * 3, "capsule": (size[0], size[0], size[0] + size[1]), "cylinder": (size[0], size[0], size[1])}
    half = np.diag(np.square(axes.get(kind, size)))
    return np.vstack([position, matrix @ half @ matrix.T])


def _touching(model: Any) -> Any:
    """Which geoms can touch by masks, excluded bodies and kinship, shape ``(geoms, geoms)``."""
    masks, affinities = model.geom_contype.astype(np.int64), model.geom_conaffinity.astype(np.int64)
    agree = (masks[:, None] & affinities) | (affinities[:, None] & masks)
    welded = model.body_weldid[model.geom_bodyid]
    parents = model.body_weldid[model.body_parentid[welded]]
    same = welded[:, None] == welded
    kin = ((parents[:, None] == welded) & (welded[:, None] != 0) & (welded != 0)) if not _keeps_parents(model) else np.zeros_like(same)
    kin |= kin.T
    excluded = np.zeros((model.nbody, model.nbody), bool)
    for signature in model.exclude_signature:
        first, second = int(signature) >> 16, int(signature) & 0xFFFF
        excluded[first, second] = excluded[second, first] = True
    bodies = model.geom_bodyid
    return (agree != 0) & ~same & ~kin & ~excluded[bodies[:, None], bodies]


def _keeps_parents(model: Any) -> bool:
    return bool(model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_FILTERPARENT))


def _without_contacts(model: Any) -> Any:
    copy = mujoco.MjModel.__copy__(model)
    copy.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    copy.opt.solver, copy.opt.tolerance, copy.opt.iterations = int(mujoco.mjtSolver.mjSOL_NEWTON), 1e-10, 200
    copy.opt.cone = int(mujoco.mjtCone.mjCONE_PYRAMIDAL)
    return copy


def _set_joint(first: Any, second: Any, there: Any, here: Any, old: int, new: int, amount: float, random: Any) -> None:
    """Move a joint of both models by the same random amount."""
    kind = int(there.jnt_type[old])
    count = {0: 6, 1: 3}.get(kind, 1)
    moved, velocity = random.uniform(-amount, amount, count), random.uniform(-amount, amount, count)
    for data, model, joint in ((first, there, old), (second, here, new)):
        coordinate, dof = model.jnt_qposadr[joint], model.jnt_dofadr[joint]
        data.qvel[dof : dof + count] = velocity
        if count == 1:
            data.qpos[coordinate] += moved[0]
            continue
        turn = np.zeros(4)
        mujoco.mju_axisAngle2Quat(turn, moved[-3:] / max(1e-9, np.linalg.norm(moved[-3:])), float(np.linalg.norm(moved[-3:])))
        start = coordinate + count - 3
        if count == 6:
            data.qpos[coordinate : coordinate + 3] += moved[:3]
        data.qpos[start : start + 4] = turn if kind == 1 else turn

