"""Contacts of bodies or geoms: forces, durations, and peaks within a control step."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import mujoco
import newton
import numpy as np
import torch
import warp as wp

from shared_store.contract.error_text import nearest
from worker.simulation.robot_view import RobotView
from worker.simulation.sensors.sensor import Sensor, SensorContext, SensorDeclaration, place_names
from worker.simulation.structs import filled

wp.set_module_options({"enable_backward": False})

GROUND = "ground"
"""Name in ``ContactSensor.against`` of everything fixed to the world."""
_PYRAMIDAL = wp.constant(int(mujoco.mjtCone.mjCONE_PYRAMIDAL))


@wp.struct
class ContactArrays:
    """Latest measurements of a contact sensor, one row per world, one column per body or geom.

    Attributes:
        found: Contacts in the last physics step, shape ``(worlds, columns)``.
        forces: Sum of the contact forces on the body or geom in the last physics step, in the world frame [N], shape
            ``(worlds, columns)``. Forces between two geoms of one column cancel.
        air_time: Time since contact was lost, 0 during contact [s], shape ``(worlds, columns)``.
        contact_time: Time since contact began, 0 without contact [s], shape ``(worlds, columns)``.
        last_air_time: Duration of the last period without contact, up to the end of the step in which contact began [s], shape ``(worlds,
            columns)``; 0 before the first one of an episode.
        last_contact_time: Duration of the last contact [s], shape ``(worlds, columns)``.
        peaks: Greatest norm of ``forces`` in the physics steps of ``history`` [N], shape ``(worlds, columns)``.
        history: Norm of the strongest single contact in each of the last physics steps [N], the last one first, shape
            ``(worlds, columns, steps)``: those of one control step where the sensor is ``fine``, else the last one alone.
        step: Time between two measurements [s]: a physics step where the sensor is ``fine``, else a control step.
        seconds: Length of a control step [s].
    """

    found: wp.array2d[wp.int32]
    forces: wp.array2d[wp.vec3]
    air_time: wp.array2d[wp.float32]
    contact_time: wp.array2d[wp.float32]
    last_air_time: wp.array2d[wp.float32]
    last_contact_time: wp.array2d[wp.float32]
    peaks: wp.array2d[wp.float32]
    history: wp.array3d[wp.float32]
    step: float
    seconds: float


@wp.func
def first_contact(contacts: ContactArrays, world: int, column: int) -> bool:
    """Whether a contact that still lasts began within the last control step."""
    time = contacts.contact_time[world, column]
    return time > 0.0 and time < contacts.seconds + 0.5 * contacts.step


@wp.func
def first_air(contacts: ContactArrays, world: int, column: int) -> bool:
    """Whether contact was lost within the last control step, and has not come back."""
    time = contacts.air_time[world, column]
    return time > 0.0 and time < contacts.seconds + 0.5 * contacts.step


@wp.func
def strongest_contact(contacts: ContactArrays, world: int, column: int) -> float:
    """Norm of the strongest single contact in ``history`` [N]."""
    strongest = float(0.0)
    for step in range(contacts.history.shape[2]):
        strongest = wp.max(strongest, contacts.history[world, column, step])
    return strongest


@wp.func
def steps_above(contacts: ContactArrays, world: int, column: int, force: float) -> int:
    """In how many physics steps of ``history`` a single contact was stronger than ``force`` [N]."""
    steps = int(0)  # noqa: RUF046 (a variable for Warp, not a constant)
    for step in range(contacts.history.shape[2]):
        if contacts.history[world, column, step] > force:
            steps = steps + 1
    return steps


@wp.struct
class _Solved:
    """The solver's contacts of one physics step, those of all worlds in one list, as in ``mujoco_warp.Data.contact``."""

    cone: int
    rows: int
    count: wp.array[wp.int32]
    worlds: wp.array[wp.int32]
    geoms: wp.array[wp.vec2i]
    dims: wp.array[wp.int32]
    frames: wp.array[wp.mat33]
    friction: wp.array2d[wp.float32]
    adhesion: wp.array[wp.float32]
    addresses: wp.array2d[wp.int32]
    forces: wp.array2d[wp.float32]


@wp.struct
class _Sums:
    """Sums over the contacts of one physics step, shape ``(worlds, columns)``; cleared by the kernel that reads them."""

    found: wp.array2d[wp.int32]
    forces: wp.array2d[wp.vec3]
    strongest: wp.array2d[wp.float32]


@wp.func
def _constraint_force(solved: _Solved, world: int, address: int) -> float:
    """Force of one row of constraints; rows beyond the solver's memory were dropped."""
    if address < 0 or address >= solved.rows:
        return 0.0
    return solved.forces[world, address]


@wp.func
def _contact_force(solved: _Solved, contact: int, world: int) -> wp.vec3:
    """Force of a contact on its second geom, in the world frame [N]; ``mj_contactForce`` of MuJoCo without the torque.

    An elliptic cone has one row of constraints for each direction. A pyramid has two edges for each direction of friction,
    n + mu t and n - mu t, and the force is the sum over the edges.
    """
    force = wp.vec3(0.0, 0.0, 0.0)
    dim = solved.dims[contact]
    if dim == 1 or solved.cone != _PYRAMIDAL:
        for axis in range(wp.min(dim, 3)):
            force[axis] = _constraint_force(solved, world, solved.addresses[contact, axis])
    else:
        for edge in range(dim - 1):
            address = solved.addresses[contact, 0] + 2 * edge
            plus = _constraint_force(solved, world, address)
            minus = _constraint_force(solved, world, address + 1)
            force[0] = force[0] + plus + minus
            if edge < 2:
                force[edge + 1] = solved.friction[contact, edge] * (plus - minus)
    force[0] = force[0] - solved.adhesion[contact]
    return wp.transpose(solved.frames[contact]) * force


@wp.func
def _add(sums: _Sums, world: int, column: int, force: wp.vec3, strength: float):
    wp.atomic_add(sums.found, world, column, 1)
    wp.atomic_add(sums.forces, world, column, force)
    wp.atomic_max(sums.strongest, world, column, strength)


@wp.kernel
def _gather(solved: _Solved, columns: wp.array[wp.int32], others: wp.array[wp.int32], sums: _Sums):
    """Sum one contact up for the geoms that have a column, if the other geom is one of ``others``."""
    contact = wp.tid()
    if contact >= solved.count[0] or solved.addresses[contact, 0] < 0:
        return
    pair = solved.geoms[contact]
    if pair[0] < 0 or pair[1] < 0:
        return
    first = columns[pair[0]]
    second = columns[pair[1]]
    if others[pair[1]] == 0:
        first = -1
    if others[pair[0]] == 0:
        second = -1
    if first < 0 and second < 0:
        return
    world = solved.worlds[contact]
    force = _contact_force(solved, contact, world)
    strength = wp.length(force)
    if first == second:
        _add(sums, world, first, wp.vec3(0.0, 0.0, 0.0), strength)
        return
    if first >= 0:
        _add(sums, world, first, -force, strength)
    if second >= 0:
        _add(sums, world, second, force, strength)


@wp.kernel
def _measure(sums: _Sums, contacts: ContactArrays, norms: wp.array3d[wp.float32]):
    """Reduces the contacts of one physics step to one column; ``norms`` is the past of the net force."""
    world, column = wp.tid()
    found = sums.found[world, column]
    force = sums.forces[world, column]
    strongest = sums.strongest[world, column]
    sums.found[world, column] = 0
    sums.forces[world, column] = wp.vec3(0.0, 0.0, 0.0)
    sums.strongest[world, column] = 0.0

    contacts.found[world, column] = found
    contacts.forces[world, column] = force
    peak = wp.length(force)
    steps = contacts.history.shape[2]
    for back in range(steps - 1):
        slot = steps - 1 - back
        contacts.history[world, column, slot] = contacts.history[world, column, slot - 1]
        norms[world, column, slot] = norms[world, column, slot - 1]
        peak = wp.max(peak, norms[world, column, slot])
    contacts.history[world, column, 0] = strongest
    norms[world, column, 0] = wp.length(force)
    contacts.peaks[world, column] = peak

    air = contacts.air_time[world, column]
    touch = contacts.contact_time[world, column]
    if found > 0:
        if air > 0.0:
            contacts.last_air_time[world, column] = air + contacts.step
        contacts.air_time[world, column] = 0.0
        contacts.contact_time[world, column] = touch + contacts.step
    else:
        if touch > 0.0:
            contacts.last_contact_time[world, column] = touch + contacts.step
        contacts.contact_time[world, column] = 0.0
        contacts.air_time[world, column] = air + contacts.step


@wp.kernel
def _forget(ages: wp.array[wp.int32], contacts: ContactArrays, norms: wp.array3d[wp.float32]):
    """Clear a column of a world that was placed afresh."""
    world, column = wp.tid()
    if ages[world] != 0:
        return
    contacts.found[world, column] = 0
    contacts.forces[world, column] = wp.vec3(0.0, 0.0, 0.0)
    contacts.air_time[world, column] = 0.0
    contacts.contact_time[world, column] = 0.0
    contacts.last_air_time[world, column] = 0.0
    contacts.last_contact_time[world, column] = 0.0
    contacts.peaks[world, column] = 0.0
    for step in range(norms.shape[2]):
        contacts.history[world, column, step] = 0.0
        norms[world, column, step] = 0.0


class Contacts(Sensor):
    """A :class:`ContactSensor` of some worlds."""

    state = (
        *("found", "forces", "air_time", "contact_time", "last_air_time", "last_contact_time"),
        *("peaks", "history"),
    )

    def __init__(self, declared: ContactSensor, context: SensorContext) -> None:
        worlds = context.worlds
        if not worlds.solver.mjw_data.naconmax:
            raise ValueError(
                "ContactSensor: the solver computes no contacts; give solver_options nconmax and no disable_contacts"
            )
        names, columns, others = _rows(declared, context)
        super().__init__(context, names)
        self._fine, self._shape = declared.fine, (self._count, len(names))
        self._columns = wp.array(columns, dtype=wp.int32, device=self._device)
        self._others = wp.array(others, dtype=wp.int32, device=self._device)
        steps, seconds = worlds.substeps if declared.fine else 1, 1.0 / context.control_hz
        self.arrays = filled(
            ContactArrays,
            self._device,
            self._shape,
            history=context.array((*self._shape, steps), wp.float32),
            seconds=seconds,
            step=worlds.timestep if declared.fine else seconds,
        )
        self._norms = context.array((*self._shape, steps), wp.float32)
        self._sums, self._solved = filled(_Sums, self._device, self._shape), _solved(worlds.solver)
        if declared.fine:
            worlds.after_substep.append(self._measure)

    def advance(self) -> None:
        """Measure the last physics step, unless each was measured when it was taken."""
        if not self._fine:
            self._measure()

    def settle(self) -> None:
        """Clear contact and air times of worlds that were just reset."""
        self._launch(_forget, self._shape, self._episodes.ages, self.arrays, self._norms)

    def state_tensors(self) -> dict[str, torch.Tensor]:
        """All measurements: times continue from them, and code before the next physics reads them."""
        return super().state_tensors() | {"norms": wp.to_torch(self._norms)}

    def _measure(self) -> None:
        if count := self._solved.worlds.shape[0]:
            self._launch(_gather, count, self._solved, self._columns, self._others, self._sums)
        self._launch(_measure, self._shape, self._sums, self.arrays, self._norms)


def _rows(declared: ContactSensor, context: SensorContext) -> tuple[list[str], np.ndarray, np.ndarray]:
    """Names of the columns; column of each geom of the solver, -1 where it is not measured; whether touching each geom counts, 1 or 0."""
    view = context.view(declared.robot, "ContactSensor.robot")
    shapes = _shapes_of_geoms(context)
    groups = _groups(declared, view, set(shapes.tolist()))
    if declared.together:
        groups = {view.name: [shape for measured in groups.values() for shape in measured]}
    columns = np.full(len(shapes), -1, np.int32)
    for column, measured in enumerate(groups.values()):
        columns[np.isin(shapes, measured)] = column
    others = _others(declared, context, shapes)
    if not others.any():
        raise ValueError(f"ContactSensor.against: nothing of {declared.against!r} can collide; {_choices(context)}")
    return list(groups), columns, others.astype(np.int32)


def _groups(declared: ContactSensor, view: RobotView, solid: set[int]) -> dict[str, list[int]]:
    """The shapes of each column, by the column's name. ``solid`` are the shapes that can collide; matches without one are skipped."""
    if (declared.bodies is None) == (declared.geoms is None):
        raise ValueError("ContactSensor: give either bodies or geoms, a pattern or several, and not both")
    if declared.geoms is None:
        patterns, names, find = declared.bodies, view.body_names, view.find_bodies
        owned = [
            [shape for shape, owner in zip(view.geoms, view.geom_bodies, strict=True) if owner == body]
            for body in view.bodies
        ]
    else:
        patterns, names, find, owned = declared.geoms, view.geom_names, view.find_geoms, [[geom] for geom in view.geoms]
    found: dict[int, list[int]] = {}
    for pattern in [patterns] if isinstance(patterns, str) or not patterns else patterns:
        matching = find(pattern or ())
        colliding = {index: owned[index] for index in matching if not solid.isdisjoint(owned[index])}
        if not colliding:
            what = ", ".join(names[index] for index in matching)
            able = [name for name, shape in zip(view.geom_names, view.geoms, strict=True) if shape in solid]
            raise ValueError(
                f"ContactSensor: {what} of {view.name} has no geom that can collide; geoms that can: {', '.join(able) or 'none'}"
            )
        found |= colliding
    return {names[index]: found[index] for index in sorted(found)}


def _shapes_of_geoms(context: SensorContext) -> np.ndarray:
    """Index of each geom of the solver among the shapes of a world; -1 where it is in all worlds."""
    model, solver = context.worlds.model, context.worlds.solver
    shapes = solver.mjc_geom_to_newton_shape.numpy()[0]
    world = model.shape_world.numpy()
    first = int((world == 0).argmax())  # those of the first world are in one piece
    own: np.ndarray = np.where((shapes >= 0) & (world[shapes] == 0), shapes - first, -1)
    return own


def _others(declared: ContactSensor, context: SensorContext, shapes: np.ndarray) -> np.ndarray:
    """The solver's geoms that the measured ones must touch."""
    if declared.against is None:
        return np.ones(len(shapes), bool)
    if declared.against != GROUND:
        if declared.against not in context.views:
            raise ValueError(f"ContactSensor.against: there is no {declared.against!r}; {_choices(context, declared)}")
        return np.isin(shapes, context.views[declared.against].geoms)
    model = context.worlds.model
    shape = context.worlds.solver.mjc_geom_to_newton_shape.numpy()[0]
    owned = np.isin(shapes, [geom for view in context.views.values() for geom in view.geoms])
    plane = model.shape_type.numpy()[shape] == int(newton.GeoType.PLANE)
    ground: np.ndarray = (shape >= 0) & (model.shape_body.numpy()[shape] < 0) & (plane | ~owned)
    return ground


def _choices(context: SensorContext, declared: ContactSensor | None = None) -> str:
    known: Sequence[str] = (GROUND, *context.views)
    return nearest(declared.against if declared else "", known) + " (None: anything)"


def _solved(solver: Any) -> Any:
    """The :class:`_Solved` of a solver: views of its own arrays, whose addresses never change."""
    data, contact = solver.mjw_data, solver.mjw_data.contact
    return filled(
        _Solved,
        None,
        cone=int(solver.mjw_model.opt.cone),
        rows=int(data.njmax),
        count=data.nacon,
        worlds=contact.worldid,
        geoms=contact.geom,
        dims=contact.dim,
        frames=contact.frame,
        friction=contact.friction.view(wp.float32).reshape((contact.friction.shape[0], -1)),
        adhesion=contact.adhesion,
        addresses=contact.efc_address,
        forces=data.efc.force,
    )


@dataclass(frozen=True)
class ContactSensor(SensorDeclaration):
    """Contacts of bodies or of geoms with the ground, a robot, an object or anything.

    Attributes:
        bodies: Pattern or patterns of the measured bodies, each a column; all geoms of a body count. Give this or ``geoms``.
        geoms: Pattern or patterns of the measured geoms, each a column. Geoms that can't collide are skipped.
        robot: The robot with these bodies or geoms.
        against: The other side of contacts that count: ``"ground"`` (planes, and shapes fixed to the world that belong to no robot or
            object), the name of a robot or object (the name in ``robot`` means self-contacts), or None: anything.
        fine: Whether every physics step is measured, not only the last of a control step. Times are then exact to a physics step, and
            ``history`` and ``peaks`` cover a control step. It costs two launches per physics step instead of per control step.
        together: Whether all measurements are summed in one column, named after the robot.
    """

    bodies: str | Sequence[str] | None = None
    geoms: str | Sequence[str] | None = None
    robot: str = "robot"
    against: str | None = "ground"
    fine: bool = False
    together: bool = False
    arrays_type: ClassVar[Any] = ContactArrays
    sensor_type: ClassVar[Any] = Contacts

    def rows(self, views: Mapping[str, RobotView]) -> list[str]:
        """Name of each column, of these robots and objects. Raises ValueError where a pattern or a name matches nothing."""
        if self.together:
            return [self.robot]
        return place_names(views, "ContactSensor", self.robot, bodies=self.bodies, geoms=self.geoms)
