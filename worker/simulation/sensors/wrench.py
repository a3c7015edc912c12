"""External forces and torques on bodies of a robot or object. It measures nothing: it keeps the wrenches that events apply, and ends
them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import warp as wp

from worker.simulation.episodes import EpisodeArrays
from worker.simulation.robot_view import RobotView
from worker.simulation.sensors.sensor import Sensor, SensorContext, SensorDeclaration, place_names
from worker.simulation.structs import filled

wp.set_module_options({"enable_backward": False})

LASTING = wp.constant(-1.0)
"""``WrenchArrays.left`` of a wrench that lasts until the episode ends."""
LASTING_FROM_NOW = wp.constant(-2.0)
"""The same for a wrench applied after the last physics: if an episode just began, the wrench belongs to the new one."""


@wp.struct
class WrenchArrays:
    """External wrenches on the bodies, one row per world.

    Attributes:
        wrenches: Force at a body's centre of mass [N] and torque [N m], in the world frame, shape ``(worlds, bodies of a world)``.
        bodies: Columns of the pushed bodies, shape ``(pushed,)``.
        left: Remaining duration [s], 0 without a wrench, :data:`LASTING` or :data:`LASTING_FROM_NOW`; shape ``(worlds,)``.
    """

    wrenches: wp.array2d[wp.spatial_vectorf]
    bodies: wp.array[wp.int32]
    left: wp.array[wp.float32]


@wp.func
def end_wrenches(wrench: WrenchArrays, world: int):
    """Nothing acts from outside any more."""
    wrench.left[world] = 0.0
    for index in range(wrench.bodies.shape[0]):
        wrench.wrenches[world, wrench.bodies[index]] = wp.spatial_vector(wp.vec3(0.0), wp.vec3(0.0))


@wp.kernel
def _pass_time(seconds: float, wrench: WrenchArrays):
    """A control step is over."""
    world = wp.tid()
    if wrench.left[world] == LASTING_FROM_NOW:
        wrench.left[world] = LASTING
    if wrench.left[world] > 0.0:
        wrench.left[world] = wrench.left[world] - seconds
        if wrench.left[world] < 0.5 * seconds:
            end_wrenches(wrench, world)


@wp.kernel
def _end_with_the_episode(episodes: EpisodeArrays, wrench: WrenchArrays):
    world = wp.tid()
    if episodes.ages[world] == 0 and wrench.left[world] != LASTING_FROM_NOW:
        end_wrenches(wrench, world)


class WrenchKeeper(Sensor):
    """:class:`ExternalWrench` of some worlds."""

    state = ("wrenches", "left")

    def __init__(self, declared: ExternalWrench, context: SensorContext) -> None:
        super().__init__(context, declared.rows(context.views))
        view = context.views[declared.robot]
        columns = [view.bodies[each] for each in view.find_bodies(declared.bodies)]
        for name, column in zip(self.names, columns, strict=True):
            if column in self._worlds.pushed:
                raise ValueError(f"ExternalWrench.bodies: {name} is pushed by another ExternalWrench already")
        self._worlds.pushed.update(columns)
        wrenches = self._worlds.state.body_f.reshape((self._count, -1))
        self.arrays = filled(WrenchArrays, self._device, (self._count,), wrenches=wrenches, bodies=columns)

    def advance(self) -> None:
        """After a control step: end wrenches whose duration is over."""
        self._launch(_pass_time, self._count, 1.0 / self._context.control_hz, self.arrays)

    def settle(self) -> None:
        """End the wrenches of the previous episode."""
        self._launch(_end_with_the_episode, self._count, self._episodes, self.arrays)


@dataclass(frozen=True)
class ExternalWrench(SensorDeclaration):
    """Forces and torques on bodies, which ``terms.apply_wrench`` and ``terms.apply_impulse`` draw. They end with the episode.

    Attributes:
        bodies: Pattern or patterns of the pushed bodies. A body belongs to at most one declaration.
        robot: The robot with these bodies.
    """

    bodies: str | Sequence[str]
    robot: str = "robot"
    arrays_type: ClassVar[Any] = WrenchArrays
    sensor_type: ClassVar[Any] = WrenchKeeper

    def rows(self, views: Mapping[str, RobotView]) -> list[str]:
        """Name of each body that is pushed. Raises ValueError where a pattern or a name matches nothing."""
        return place_names(views, "ExternalWrench", self.robot, bodies=self.bodies)
