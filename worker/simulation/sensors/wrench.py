"""Forces and torques from outside on bodies of a robot or object: it measures nothing, but keeps and ends what events apply."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
import warp as wp

from worker.simulation.episodes import EpisodeArrays
from worker.simulation.robot_view import RobotView
from worker.simulation.sensors.places import place_names
from worker.simulation.sensors.sensor import SensorContext, views_of

wp.set_module_options({"enable_backward": False})

LASTING = wp.constant(-1.0)
"""``WrenchArrays.left`` of what acts until the episode ends."""
LASTING_FROM_NOW = wp.constant(-2.0)
"""The same, of what was applied after the last physics: where an episode begins, it is the new one's."""


@wp.struct
class WrenchArrays:
    """What acts on the bodies from outside, one row a world.

    Attributes:
        wrenches: Force at a body's centre of mass [N] and torque [N m], in the world frame, shape ``(worlds, bodies of a world)``.
        bodies: Columns of the bodies that are pushed, shape ``(pushed,)``.
        left: How long they still act [s], 0 where nothing does, :data:`LASTING` or :data:`LASTING_FROM_NOW`; shape ``(worlds,)``.
    """

    wrenches: wp.array2d(dtype=wp.spatial_vector)
    bodies: wp.array(dtype=wp.int32)
    left: wp.array(dtype=wp.float32)


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


@dataclass(frozen=True)
class ExternalWrench:
    """Forces and torques on bodies, which ``terms.apply_wrench`` and ``terms.apply_impulse`` draw. They end with the episode.

    Attributes:
        bodies: Pattern or patterns of the bodies that are pushed. A body belongs to one declaration.
        robot: Whose bodies they are.
    """

    bodies: str | Sequence[str]
    robot: str = "robot"
    arrays_type: ClassVar[Any] = WrenchArrays

    def rows(self, views: Mapping[str, RobotView]) -> list[str]:
        """Name of each body that is pushed. Raises ValueError where a pattern or a name matches nothing."""
        return place_names(views, "ExternalWrench", self.robot, bodies=self.bodies)

    def build(self, context: SensorContext) -> WrenchKeeper:
        """What keeps the forces of these worlds.

        Raises:
            ValueError: A pattern matches nothing, or another declaration pushes one of the bodies.
        """
        view = context.view(self.robot, "ExternalWrench.robot")
        found = view.find_bodies(self.bodies)
        names = tuple(view.body_names[each] for each in found)
        columns = [view.bodies[each] for each in found]
        for name, column in zip(names, columns, strict=True):
            if column in context.worlds.pushed:
                raise ValueError(f"ExternalWrench.bodies: {name} is pushed by another ExternalWrench already")
        context.worlds.pushed.update(columns)
        return WrenchKeeper(names, columns, context)


class WrenchKeeper:
    """:class:`ExternalWrench` of some worlds; see :class:`worker.simulation.sensors.sensor.Sensor`.

    Args:
        names: Of the bodies.
        columns: Theirs, among all bodies of a world.
        context: The worlds.
    """

    needs_bodies = False

    def __init__(self, names: tuple[str, ...], columns: list[int], context: SensorContext) -> None:
        self.names, self._context = names, context
        self._count = context.worlds.world_count
        self.arrays = WrenchArrays()
        self.arrays.wrenches = context.worlds.state.body_f.reshape((self._count, -1))
        self.arrays.bodies = wp.array(columns, dtype=wp.int32, device=context.device)
        self.arrays.left = context.array((self._count,), wp.float32)

    def advance(self) -> None:
        """A control step is over: what has acted long enough ends."""
        inputs = [1.0 / self._context.control_hz, self.arrays]
        wp.launch(_pass_time, dim=self._count, inputs=inputs, device=self._context.device)

    def settle(self) -> None:
        """What acted in the episode before ends."""
        inputs = [self._context.episodes, self.arrays]
        wp.launch(_end_with_the_episode, dim=self._count, inputs=inputs, device=self._context.device)

    def state_tensors(self) -> dict[str, torch.Tensor]:
        """What acts in the next physics, and for how long."""
        return views_of(self.arrays, "wrenches", "left")
