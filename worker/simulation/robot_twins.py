"""The twins of a robot: its file as MuJoCo compiles it, the model that the builder becomes, and which element is which."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Hashable, Iterable
from functools import cached_property
from typing import Any

import mujoco_warp
import newton
import numpy as np
import warp as wp

from worker.simulation.robot_elements import (
    Ends,
    Pairs,
    count_of,
    effective_geoms,
    equality_ends,
    is_carrier,
    kind_of,
    name_of,
    names_of,
    pair_ends,
    paired,
    plain,
    short,
    tendon_ends,
    unload,
)
from worker.simulation.robot_values import freedoms, gravity, without_contacts
from worker.simulation.robot_view import dof_names, joint_of
from worker.simulation.solver import Solver, is_slider, weigh_sliders

OTHER = -2
"""Stands for the index in the file of an element that the file does not have."""
MEDIUM_AND_FLAGS = ("gravity", "wind", "density", "viscosity", "disableflags", "enableflags", "disableactuator")
"""Options of ``mujoco.MjModel`` that change accelerations, and that a task need not take from the file."""


class Stepped:
    """A compiled model with the arrays that MuJoCo-Warp steps, which knows fewer of them.

    Args:
        model: The compiled model, ``mujoco.MjModel``.

    Raises:
        AttributeError: MuJoCo-Warp has no array of that name.
    """

    def __init__(self, model: Any) -> None:
        self._compiled = model
        with wp.ScopedDevice("cpu"):
            self._model: Any = mujoco_warp.put_model(model)

    def __getattr__(self, name: str) -> Any:
        compiled = getattr(self._compiled, name)
        if isinstance(compiled, np.ndarray):
            shape, values = compiled.shape, getattr(self._model, name)
            found = values.numpy() if isinstance(values, wp.array) else np.asarray(values)
            found = found[0] if found.size and found.ndim > len(shape) else found
            compiled = found.reshape(shape).astype(compiled.dtype)
        vars(self)[name] = compiled  # so that this is called once
        return compiled


class Twins:
    """Both models of one robot.

    Args:
        reference: The file's compiled model, ``mujoco.MjModel``.
        builder: Holds the robot alone, as imported.

    Attributes:
        file: The file's compiled model, ``mujoco.MjModel``.
        builder: The builder.
        built: The compiled model of the builder, ``mujoco.MjModel``.
        stepped: The values of the same model that MuJoCo-Warp steps.
    """

    def __init__(self, reference: Any, builder: newton.ModelBuilder) -> None:
        self.file, self.builder = reference, builder
        gaps = builder.shape_gap  # as of the worlds
        builder.shape_gap = [0.0 if gap == builder.rigid_gap else gap for gap in gaps]
        try:
            model = builder.finalize(device="cpu")
        finally:
            builder.shape_gap = gaps
        solver = Solver(
            model, use_mujoco_cpu=True, separate_worlds=False, kinematic_switchable_roots=False, disable_sensors=True
        )
        unload(model, solver)
        self.built: Any = solver.mj_model
        self.body_indices = _column(solver.mjc_body_to_newton)
        """Index of each body of :attr:`built` among the builder's, -1 for the world."""
        self.dofs = _column(solver.mjc_jnt_to_newton_dof)
        """Index of the first degree of freedom of each joint of :attr:`built` among the builder's."""
        self._shapes = _column(solver.mjc_geom_to_newton_shape)
        self._site_shapes = _column(solver._mjc_site_to_newton_shape)
        self._in_file: dict[str, dict[int, int]] = {}
        sliders = [twin for body, twin in self.bodies.items() if is_slider(reference, body)]
        weigh_sliders(self.built, sliders)
        self.sliders = [self.body_indices[twin] for twin in sliders]
        """Indices among the builder's bodies of those that MuJoCo finds to be sliders."""
        self.stepped = Stepped(self.built)

    def name(self, kind: str, index: int) -> str:
        """Kind and name of an element of the file."""
        return f"{kind} {name_of(self.file, kind_of(kind), int(index))}"

    def built_body(self, index: int) -> str:
        """Name of a body of the built model."""
        return short(self.builder.body_label[self.body_indices[index]]) if index else "world"

    def built_joint(self, index: int) -> str:
        """Name of a joint of the built model."""
        dof = self.dofs[index]
        joint = joint_of(self.builder, dof)
        if self.builder.joint_type[joint] in (newton.JointType.FREE, newton.JointType.BALL):
            return short(self.builder.joint_label[joint])
        return dof_names(self.builder, joint)[dof - self.builder.joint_qd_start[joint]]

    @cached_property
    def bodies(self) -> Pairs:
        """The bodies, the world among them."""
        names = {
            index: plain(self.built_body(index))
            for index in range(1, self.built.nbody)
            if not is_carrier(self.built_body(index))
        }
        return {0: 0} | paired(names_of(self.file, "body", range(1, self.file.nbody)), names)

    @cached_property
    def joints(self) -> Pairs:
        """The joints."""
        names = {index: plain(self.built_joint(index)) for index in range(self.built.njnt)}
        return paired(names_of(self.file, "joint", range(self.file.njnt)), names)

    @cached_property
    def geoms(self) -> Pairs:
        """The geoms that can touch or that tendons wrap: Newton leaves out those that are only seen."""
        model, built = self.file, self.built
        file_names, theirs = names_of(model, "geom", effective_geoms(model)), effective_geoms(built)
        pairs: Pairs = {}
        for body, twin in self.bodies.items():
            names = {
                geom: plain(short(self.builder.shape_label[self._shapes[geom]]))
                for geom in theirs
                if built.geom_bodyid[geom] == twin
            }
            pairs |= paired({geom: name for geom, name in file_names.items() if model.geom_bodyid[geom] == body}, names)
        return pairs

    @cached_property
    def sites(self) -> dict[int, int | None]:
        """Index among the builder's shapes of each site of :attr:`file`; None: it is missing."""
        model, builder = self.file, self.builder
        file_names = names_of(model, "site", range(model.nsite))
        shapes = [shape for shape, flags in enumerate(builder.shape_flags) if flags & newton.ShapeFlags.SITE]
        found: dict[int, int | None] = {}
        for body, twin in self.bodies.items():
            theirs = [shape for shape in shapes if builder.shape_body[shape] == self.body_indices[twin]]
            mine = {site: name for site, name in file_names.items() if model.site_bodyid[site] == body}
            pairs = paired(mine, {shape: plain(short(builder.shape_label[shape])) for shape in theirs})
            found |= {site: pairs.get(site) for site in mine}
        return found

    @cached_property
    def tendons(self) -> Pairs:
        """The tendons: by name, then by their paths, since Newton keeps no order among their kinds."""
        names = [name or None for name in names_of(self.file, "tendon", range(self.file.ntendon)).values()]
        built = [plain(short(name_of(self.built, kind_of("tendon"), index))) for index in range(self.built.ntendon)]
        return _matched((names, built), self._both("tendon"))

    @cached_property
    def equalities(self) -> Pairs:
        """The equalities, which have no names in Newton: by their kinds and ends, then by their kinds."""
        ends, kinds = self._both("equality"), (self.file.eq_type.tolist(), self.built.eq_type.tolist())
        typed = tuple(list(zip(*each, strict=True)) for each in zip(kinds, ends, strict=True))
        return _matched((typed[0], typed[1]), kinds)

    @cached_property
    def contact_pairs(self) -> Pairs:
        """The contact pairs, by their geoms."""
        file, built = ([frozenset(ends) for ends in each] for each in self._both("pair"))
        return _matched((file, built))

    def _both(self, kind: str) -> tuple[list[Ends], list[Ends]]:
        """Ends of all elements of a kind in both models, by the file's indices."""
        ends = ENDS[kind]
        return (
            [ends(self.file, index) for index in range(count_of(self.file, kind))],
            [self.in_file(ends(self.built, index)) for index in range(count_of(self.built, kind))],
        )

    def pairs(self, kind: str) -> Pairs:
        """The elements of a kind that both models have."""
        if kind == "actuator":
            return {index: index for index in range(min(self.file.nu, self.built.nu))}
        names = {"body": "bodies", "equality": "equalities", "pair": "contact_pairs"}
        found: Pairs = getattr(self, names.get(kind, f"{kind}s"))
        return found

    def in_file(self, ends: Ends) -> Ends:
        """Ends in the built model by the indices of the same elements in the file; :data:`OTHER` where it has none."""
        return tuple((kind, self._indices(kind).get(index, OTHER) if index >= 0 else -1) for kind, index in ends)

    def _indices(self, kind: str) -> dict[int, int]:
        """Index in the file by that in the built model."""
        if kind == "site" and kind not in self._in_file:
            sites = {shape: site for site, shape in self.sites.items() if shape is not None}
            self._in_file[kind] = {site: sites.get(shape, OTHER) for site, shape in enumerate(self._site_shapes)}
        elif kind not in self._in_file:
            known = kind in ("body", "joint", "geom", "tendon")
            self._in_file[kind] = {twin: index for index, twin in self.pairs(kind).items()} if known else {}
        return self._in_file[kind]

    def shown_end(self, end: tuple[str, int]) -> str:
        """Name of an end, by its index in the file."""
        kind, index = end
        return {OTHER: f"another {kind}", -1: "nothing"}.get(index) or self.name(*end)

    def columns(self) -> tuple[list[int], list[int]]:
        """Indices of the same coordinates in ``qpos`` of :attr:`file` and of :attr:`built`."""
        file: list[int] = []
        built: list[int] = []
        for joint, twin in self.joints.items():
            count = freedoms(self.file, joint)
            width = count + (count > 1)
            file += range(self.file.jnt_qposadr[joint], self.file.jnt_qposadr[joint] + width)
            built += range(self.built.jnt_qposadr[twin], self.built.jnt_qposadr[twin] + width)
        return file, built

    def free_of_contacts(self, options: bool = True) -> tuple[Any, Any]:
        """Copies of :attr:`file` and :attr:`built` with the same options, in which nothing touches.

        Args:
            options: Whether the medium and the flags may differ; else the file's copy has the built ones.
        """
        file, built = without_contacts(self.file), without_contacts(self.built)
        built.opt.gravity = gravity(file)
        for name in () if options else MEDIUM_AND_FLAGS:
            setattr(file.opt, name, getattr(built.opt, name))
        built.opt.timestep, built.opt.integrator = file.opt.timestep, file.opt.integrator
        return file, built

    def carriers_of(self, body: int) -> list[int]:
        """The bodies of :attr:`built` that carry further joints of a body, from the nearest on."""
        above = []
        parent = int(self.built.body_parentid[body])
        while parent and is_carrier(self.built_body(parent)):
            above.append(parent)
            parent = int(self.built.body_parentid[parent])
        return above

    def held_bodies(self) -> set[int]:
        """Bodies of :attr:`file` with geoms that can touch, or that an equality joins."""
        ends = (end for equality in range(self.file.neq) for end in equality_ends(self.file, equality))
        touching = {int(self.file.geom_bodyid[geom]) for geom in self.geoms}
        return (touching | {body for kind, body in ends if kind == "body"}) & set(self.bodies)

    def joined(self) -> set[frozenset[int]]:
        """Pairs of bodies of :attr:`file` that an equality joins, by what they are welded to."""
        ends = (equality_ends(self.file, equality) for equality in range(self.file.neq))
        return {
            frozenset(int(self.file.body_weldid[body]) for _, body in pair) for pair in ends if pair[0][0] == "body"
        }


ENDS: dict[str, Callable[[Any, int], Ends]] = {"tendon": tendon_ends, "equality": equality_ends, "pair": pair_ends}
"""What says the ends of an element, by its kind."""


def _matched(*keys: tuple[Iterable[Hashable], Iterable[Hashable]]) -> Pairs:
    """Pair the elements whose first keys are equal, then of the rest those whose next ones are; equal keys in their order."""
    pairs: Pairs = {}
    for theirs, here in keys:
        taken, rest = set(pairs.values()), defaultdict(list)
        for twin, key in enumerate(here):
            if twin not in taken:
                rest[key].append(twin)
        for index, key in enumerate(theirs):
            if index not in pairs and rest[key]:
                pairs[index] = rest[key].pop(0)
    return pairs


def _column(array: Any) -> list[int]:
    return [int(each) for each in array.numpy()[0]]
