"""What every sensor has in common: how it is declared, what it is built from, and when its launches run."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Protocol

import torch
import warp as wp

from shared_store.wording import nearest
from worker.simulation.episodes import EpisodeArrays
from worker.simulation.robot_arrays import BodyArrays, RobotArrays
from worker.simulation.worlds import Worlds

if TYPE_CHECKING:
    from worker.simulation.robot_view import RobotView


@dataclass(frozen=True)
class SensorContext:
    """What sensors are built from.

    Attributes:
        worlds: Whose physics is measured.
        views: What of a world belongs to each robot or object, by its name.
        robots: Where each robot is in the rows of a world, by its name.
        bodies: Poses and velocities of the bodies of all worlds.
        episodes: The task's buffers; ``ages`` says which worlds were placed afresh.
        terrain: What the worlds stand on, as the task declares it; None where that is a plane or nothing.
        control_hz: Control steps per simulated second [Hz].
        name: What the task's declaration calls the sensor.
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
        """Where all arrays are, ``"cpu"`` or ``"cuda:<n>"``."""
        return str(self.worlds.model.device)

    def view(self, name: str, what: str) -> RobotView:
        """The robot or object of this name.

        Args:
            name: As in the declaration of the robot.
            what: Which argument of which sensor named it, for the error.

        Raises:
            ValueError: There is none of this name.
        """
        if name not in self.views:
            raise ValueError(f"{what}: there is no robot {name!r}; {nearest(name, self.views)}")
        return self.views[name]

    def array(self, shape: tuple[int, ...], dtype: Any) -> wp.array:
        """A cleared array on the device of the worlds."""
        return wp.zeros(shape, dtype=dtype, device=self.device)


class Sensor(Protocol):
    """Measures all worlds; its methods are launches only, so that they can be captured.

    Attributes:
        arrays: An instance of a Warp struct, one row a world. A term reads it through a parameter of the struct's type.
        needs_bodies: Whether body poses must be current (``Worlds.update_bodies``) when the methods below are called.
        names: What its rows are: bodies, geoms, sites.
    """

    arrays: Any
    needs_bodies: bool
    names: tuple[str, ...]

    def advance(self) -> None:
        """Measure, after the physics of a control step."""

    def settle(self) -> None:
        """After worlds were placed afresh: those with ``episodes.ages[world] == 0`` forget what was before."""

    def state_tensors(self) -> dict[str, torch.Tensor]:
        """Live views of what the next step reads, by name, each with leading dimension ``worlds``."""


class Declaration(Protocol):
    """A sensor as a task declares it: an immutable value without any array.

    Attributes:
        arrays_type: Type of the struct that its ``arrays`` are of.
    """

    arrays_type: ClassVar[Any]

    def rows(self, views: Mapping[str, RobotView]) -> list[str]:
        """Name of each column, before there are any worlds.

        Raises:
            ValueError: What it names is not there.
        """

    def build(self, context: SensorContext) -> Sensor:
        """The sensor of these worlds.

        Raises:
            ValueError: What it names is not there, or can't be measured.
        """


def views_of(arrays: Any, *names: str) -> dict[str, torch.Tensor]:
    """Live torch views of fields of a Warp struct, by name."""
    return {name: wp.to_torch(getattr(arrays, name)) for name in names}
