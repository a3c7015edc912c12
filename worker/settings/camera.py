"""The configuration of a camera in every world."""

from __future__ import annotations

import math
from typing import Annotated

from pydantic import Field
from pydantic.dataclasses import dataclass

from worker.settings.overrides import Refused, expecting
from worker.settings.task import STRICT, Finite

Place = Annotated[tuple[Finite, Finite, Finite], Field(strict=False), expecting("[x, y, z]")]


@dataclass(frozen=True, config=STRICT)
class CameraConfig:
    """Position of a world's camera, and format of its images.

    Raises:
        ValueError: A size is out of range, or the camera stands at its target.
    """

    width: Annotated[int, Field(ge=1, le=1024)] = 64
    """Width of an image [px]."""
    height: Annotated[int, Field(ge=1, le=1024)] = 64
    """Height of an image [px]."""
    position: Place = (0.0, -3.0, 1.0)
    """Its position in the world [m]."""
    target: Place = (0.0, 0.0, 1.0)
    """The point in the middle of the image [m]."""
    fov: Annotated[float, Field(gt=0, lt=math.pi)] = 0.9
    """Vertical field of view [rad]."""
    frames: Annotated[int, Field(ge=1, le=16)] = 2
    """Images of one observation: the present one and those of the control steps before, since one alone shows no velocity."""
    samples: Annotated[int, Field(ge=1, le=64)] = 1
    """Rays of each pixel; 4 or more show motions of edges by less than a pixel."""

    def __post_init__(self) -> None:
        if math.dist(self.position, self.target) < 1e-6:
            raise Refused(("target",), f"the camera stands there, at {list(self.position)}; choose another point")

    @property
    def channels(self) -> int:
        """Channels of one observation: red, green and blue of each frame, the present one first."""
        return 3 * self.frames
