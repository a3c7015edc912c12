"""The solver's geoms that a contact sensor measures, and the geoms that they must touch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import newton
import numpy as np

from shared_store.contract.error_text import nearest
from worker.simulation.sensors.sensor import SensorContext

if TYPE_CHECKING:
    from worker.simulation.robot_view import RobotView
    from worker.simulation.sensors.contact import ContactSensor

GROUND = "ground"
"""Name in ``ContactSensor.against`` of everything fixed to the world."""


@dataclass(frozen=True)
class ContactRows:
    """Geoms and columns of a contact sensor.

    Attributes:
        names: Names of its columns.
        columns: Column of each geom of the solver, -1 where it is not measured; shape ``(geoms,)``, int32.
        others: Whether touching this geom counts (1 or 0), shape ``(geoms,)``, int32.
    """

    names: tuple[str, ...]
    columns: np.ndarray
    others: np.ndarray


def contact_rows(declared: ContactSensor, context: SensorContext) -> ContactRows:
    """Find the geoms of a declaration in the worlds.

    Raises:
        ValueError: As ``ContactSensor.build``.
    """
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
    return ContactRows(tuple(groups), columns, others.astype(np.int32))


def _groups(declared: ContactSensor, view: RobotView, solid: set[int]) -> dict[str, list[int]]:
    """The shapes of each column, by the column's name. ``solid`` are the shapes that can collide; matches without one are skipped."""
    if (declared.bodies is None) == (declared.geoms is None):
        raise ValueError("ContactSensor: give either bodies or geoms, a pattern or several, and not both")
    if declared.geoms is None:
        wanted, names, find = declared.bodies, view.body_names, view.find_bodies
        owned = [
            [shape for shape, owner in zip(view.geoms, view.geom_bodies, strict=True) if owner == body]
            for body in view.bodies
        ]
    else:
        wanted, names, find, owned = declared.geoms, view.geom_names, view.find_geoms, [[geom] for geom in view.geoms]
    found: dict[int, list[int]] = {}
    for pattern in [wanted] if isinstance(wanted, str) or not wanted else wanted:
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
