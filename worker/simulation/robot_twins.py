"""A robot twice: as MuJoCo compiles its file, and as the builder made of that file becomes; and which element is which."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import mujoco
import newton
from newton.solvers import SolverMuJoCo

from worker.simulation import carriers
from worker.simulation.robot_elements import Pairs, kind_of, name_of, names_of, paired, plain, short
from worker.simulation.robot_values import freedoms, gravity, without_contacts
from worker.simulation.robot_view import dof_names, joint_of


class Twins:
    """Both models of one robot.

    Args:
        reference: The file's compiled model, ``mujoco.MjModel``.
        builder: Holds the robot alone, as imported.

    Attributes:
        file: The file's compiled model, ``mujoco.MjModel``.
        built: The compiled model of the builder, ``mujoco.MjModel``.
    """

    def __init__(self, reference: Any, builder: newton.ModelBuilder) -> None:
        self.file, self._builder = reference, builder
        model = _finalized(builder)
        solver = SolverMuJoCo(
            model, use_mujoco_cpu=True, separate_worlds=False, kinematic_switchable_roots=False, disable_sensors=True
        )
        carriers.unload(model, solver)
        self.built: Any = solver.mj_model
        self.body_indices = _column(solver.mjc_body_to_newton)
        """Index of each body of :attr:`built` among the builder's, -1 for the world."""
        self.dofs = _column(solver.mjc_jnt_to_newton_dof)
        """Index of the first degree of freedom of each joint of :attr:`built` among the builder's."""
        self._shapes = _column(solver.mjc_geom_to_newton_shape)

    def name(self, kind: str, index: int) -> str:
        """Kind and name of an element of the file."""
        return f"{kind} {name_of(self.file, kind_of(kind), int(index))}"

    def built_body(self, index: int) -> str:
        """Name of a body of the built model."""
        return short(self._builder.body_label[self.body_indices[index]]) if index else "world"

    def built_joint(self, index: int) -> str:
        """Name of a joint of the built model."""
        dof = self.dofs[index]
        joint = joint_of(self._builder, dof)
        if self._builder.joint_type[joint] in (newton.JointType.FREE, newton.JointType.BALL):
            return short(self._builder.joint_label[joint])
        return dof_names(self._builder, joint)[dof - self._builder.joint_qd_start[joint]]

    @cached_property
    def bodies(self) -> Pairs:
        """The bodies, the world among them."""
        names = {
            index: plain(self.built_body(index))
            for index in range(1, self.built.nbody)
            if not carriers.is_carrier(self.built_body(index))
        }
        return {0: 0} | paired(names_of(self.file, "body", range(1, self.file.nbody)), names)

    @cached_property
    def joints(self) -> Pairs:
        """The joints."""
        names = {index: plain(self.built_joint(index)) for index in range(self.built.njnt)}
        return paired(names_of(self.file, "joint", range(self.file.njnt)), names)

    @cached_property
    def geoms(self) -> Pairs:
        """The geoms that can touch: Newton leaves out those that are only seen."""
        model, built = self.file, self.built
        explicit = {*model.pair_geom1.tolist(), *model.pair_geom2.tolist()}
        able = [
            geom
            for geom in range(model.ngeom)
            if model.geom_contype[geom] or model.geom_conaffinity[geom] or geom in explicit
        ]
        file_names = names_of(model, "geom", able)
        pairs: Pairs = {}
        for body, twin in self.bodies.items():
            names = {
                geom: plain(short(self._builder.shape_label[shape]))
                for geom, shape in enumerate(self._shapes)
                if built.geom_bodyid[geom] == twin and (built.geom_contype[geom] or built.geom_conaffinity[geom])
            }
            pairs |= paired({geom: name for geom, name in file_names.items() if model.geom_bodyid[geom] == body}, names)
        return pairs

    @cached_property
    def sites(self) -> dict[int, int | None]:
        """Index among the builder's shapes of each site of :attr:`file`; None: it is missing."""
        model, builder = self.file, self._builder
        file_names = names_of(model, "site", range(model.nsite))
        shapes = [shape for shape, flags in enumerate(builder.shape_flags) if flags & newton.ShapeFlags.SITE]
        found: dict[int, int | None] = {}
        for body, twin in self.bodies.items():
            there = [shape for shape in shapes if builder.shape_body[shape] == self.body_indices[twin]]
            mine = {site: name for site, name in file_names.items() if model.site_bodyid[site] == body}
            pairs = paired(mine, {shape: plain(short(builder.shape_label[shape])) for shape in there})
            found |= {site: pairs.get(site) for site in mine}
        return found

    def built_site(self, shape: int) -> tuple[Any, Any]:
        """Position [m] and quaternion wxyz of a site in its body's frame."""
        pose: Any = self._builder.shape_transform[shape]
        numbers = [float(number) for number in pose]
        return numbers[:3], [numbers[6], *numbers[3:6]]

    @cached_property
    def tendons(self) -> Pairs:
        """The tendons."""
        return self._by_name("tendon", "ntendon")

    @cached_property
    def equalities(self) -> Pairs:
        """The equalities."""
        return self._by_name("equality", "neq")

    def _by_name(self, kind: str, count: str) -> Pairs:
        """Elements by their names, of the file or made, since Newton keeps no order among their kinds; the others in their order."""
        file, built = (
            {index: plain(short(name_of(model, kind_of(kind), index))) for index in range(getattr(model, count))}
            for model in (self.file, self.built)
        )
        pairs = paired(file, built)
        rest = [index for index in file if index not in pairs]
        others = [index for index in built if index not in pairs.values()]
        return pairs | dict(zip(rest, others, strict=False))

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

    def free_of_contacts(self) -> tuple[Any, Any]:
        """Copies of :attr:`file` and :attr:`built` with the same options, in which nothing touches."""
        file, built = without_contacts(self.file), without_contacts(self.built)
        built.opt.gravity = gravity(file)
        built.opt.timestep, built.opt.integrator = file.opt.timestep, file.opt.integrator
        return file, built

    def carriers_of(self, body: int) -> list[int]:
        """The bodies of :attr:`built` that carry further joints of a body, from the nearest on."""
        above = []
        parent = int(self.built.body_parentid[body])
        while parent and carriers.is_carrier(self.built_body(parent)):
            above.append(parent)
            parent = int(self.built.body_parentid[parent])
        return above

    def joined(self) -> set[frozenset[int]]:
        """Pairs of bodies of :attr:`file` that an equality joins, by what they are welded to."""
        model, weld = self.file, self.file.body_weldid
        site, body = int(mujoco.mjtObj.mjOBJ_SITE), int(mujoco.mjtObj.mjOBJ_BODY)
        pairs = set()
        for kind, first, second in zip(model.eq_objtype, model.eq_obj1id, model.eq_obj2id, strict=True):
            if kind == site:
                first, second = model.site_bodyid[[first, second]]
            if kind in (site, body):
                pairs.add(frozenset((int(weld[first]), int(weld[second]))))
        return pairs


def _finalized(builder: newton.ModelBuilder) -> newton.Model:
    """The builder's model, with the gaps of :class:`worker.simulation.worlds.Worlds`."""
    gaps = builder.shape_gap
    builder.shape_gap = [0.0 if gap == builder.rigid_gap else gap for gap in gaps]
    try:
        return builder.finalize(device="cpu")
    finally:
        builder.shape_gap = gaps


def _column(array: Any) -> list[int]:
    return [int(each) for each in array.numpy()[0]]
