"""The interface of all sensors: declaration, construction, and the order of their launches."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Protocol

import torch
import warp as wp

from shared_store.contract.error_text import nearest
from worker.simulation.episodes import EpisodeArrays
from worker.simulation.robot_arrays import BodyArrays, RobotArrays
from worker.simulation.worlds import Worlds

if TYPE_CHECKING:
    from worker.simulation.robot_view import RobotView


@dataclass(frozen=True)
class SensorContext:
    """Context from which sensors are built.

    Attributes:
        worlds: The measured worlds.
        views: View of each robot or object, by name.
        robots: Columns of each robot in the rows of a world, by name.
        bodies: Poses and velocities of the bodies of all worlds.
        episodes: The task's buffers; ``ages`` is 0 in worlds that were just reset.
        terrain: The terrain that the task declares; None for a plane or no ground.
        control_hz: Control steps per simulated second [Hz].
        name: Name of the sensor in the task's declaration.
    """

    worlds: Worlds
    views: Mapping[str, RobotView]
    robots: Mapping[str, RobotArrays]
    bodies: BodyArrays
    episodes: EpisodeArrays
    terrain: Any
    control_hz: float
    name: str = ""

    @property
    def device(self) -> str:
        """Device of all arrays, ``"cpu"`` or ``"cuda:<n>"``."""
        return str(self.worlds.model.device)

    def view(self, name: str, what: str) -> RobotView:
        """The robot or object of this name.

        Args:
            name: As in the declaration of the robot.
            what: Sensor and argument that named it, for the error.

        Raises:
            ValueError: No robot or object has this name.
        """
        if name not in self.views:
            raise ValueError(f"{what}: there is no robot {name!r}; {nearest(name, self.views)}")
        return self.views[name]

    def array(self, shape: tuple[int, ...], dtype: Any) -> wp.array[Any]:
        """A cleared array on the device of the worlds."""
        return wp.zeros(shape, dtype=dtype, device=self.device)


class Sensor(Protocol):
    """Measures all worlds; its methods are launches only, so that they can be captured.

    Attributes:
        arrays: An instance of a Warp struct, one row per world. A term reads it through a parameter of the struct's type.
        needs_bodies: Whether body poses must be current (``Worlds.update_bodies``) when the methods below are called.
        names: Names of its columns: bodies, geoms or sites.
    """

    arrays: Any
    needs_bodies: bool
    names: tuple[str, ...]

    def advance(self) -> None:
        """Measure, after the physics of a control step."""

    def settle(self) -> None:
        """Called after resets: worlds with ``episodes.ages[world] == 0`` forget their past."""

    def state_tensors(self) -> dict[str, torch.Tensor]:
        """Live views of the state that the next step reads, by name, each with leading dimension ``worlds``."""


class SensorDeclaration(Protocol):
    """Declaration of a sensor: an immutable value without arrays.

    Attributes:
        arrays_type: Struct type of its ``arrays``.
    """

    arrays_type: ClassVar[Any]

    def rows(self, views: Mapping[str, RobotView]) -> list[str]:
        """Name of each column, before any worlds exist.

        Raises:
            ValueError: It names something unknown.
        """

    def build(self, context: SensorContext) -> Sensor:
        """The sensor of these worlds.

        Raises:
            ValueError: It names something unknown, or something that can't be measured.
        """


def views_of(arrays: Any, *names: str) -> dict[str, torch.Tensor]:
    """Live torch views of fields of a Warp struct, by name."""
    return {name: wp.to_torch(getattr(arrays, name)) for name in names}
