"""Selection of one object out of several, in each world. It measures nothing: a command chooses the object, and terms read the choice."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import warp as wp

from worker.simulation.patterns import find
from worker.simulation.robot_arrays import RobotArrays
from worker.simulation.robot_view import RobotView
from worker.simulation.sensors.sensor import Sensor, SensorContext, SensorDeclaration
from worker.simulation.structs import filled

wp.set_module_options({"enable_backward": False})


@wp.struct
class SelectionArrays:
    """Objects, and the selected one in each world.

    Attributes:
        chosen: 1 for the selected object, 0 for the others, shape ``(worlds, objects)``.
        coordinates: First column of each object's root in ``WorldArrays.joint_q`` (position, quaternion xyzw), shape ``(objects,)``.
        dofs: First column of each object's root in ``WorldArrays.joint_qd`` (linear, angular), shape ``(objects,)``.
    """

    chosen: wp.array2d[wp.float32]
    coordinates: wp.array[wp.int32]
    dofs: wp.array[wp.int32]


@wp.func
def object_at(objects: SelectionArrays, index: int) -> RobotArrays:
    """An object by its column; only its root is set."""
    found = RobotArrays()
    found.root_coordinate = objects.coordinates[index]
    found.root_dof = objects.dofs[index]
    return found


@wp.func
def chosen_one(objects: SelectionArrays, world: int) -> RobotArrays:
    """The object that counts; only its root is set."""
    chosen = objects.coordinates.shape[0] - 1
    for index in range(chosen):
        if objects.chosen[world, index] > 0.5:
            chosen = index
    return object_at(objects, chosen)


class Selection(Sensor):
    """:class:`ObjectSelection` of some worlds; the command of a new episode selects the object."""

    state = ("chosen",)

    def __init__(self, declared: ObjectSelection, context: SensorContext) -> None:
        super().__init__(context, declared.rows(context.views))
        views = [context.views[name] for name in self.names]
        columns = {"coordinates": [v.root_coordinate for v in views], "dofs": [v.root_dof for v in views]}
        self.arrays = filled(SelectionArrays, self._device, (self._count, len(views)), **columns)


@dataclass(frozen=True)
class ObjectSelection(SensorDeclaration):
    """Objects from which a command selects one: ``terms.lift_one_command`` draws it, and ``terms.chosen_object_...`` read it.

    Attributes:
        objects: Pattern or patterns of names, as the task's ``objects`` gives them. Their roots are free.
    """

    objects: str | Sequence[str]
    arrays_type: ClassVar[Any] = SelectionArrays
    sensor_type: ClassVar[Any] = Selection

    def rows(self, views: Mapping[str, RobotView]) -> list[str]:
        """Name of each object. Raises ValueError where a pattern matches nothing, or an object that is fixed to the world."""
        names = [*views]
        found = [names[index] for index in find(names, self.objects, "object")]
        for name in found:
            if views[name].root_coordinate < 0:
                raise ValueError(f"ObjectSelection: {name} is fixed to the world; leave it out")
        return found
