"""Obstacles on a track, as a job's configuration has them."""

from __future__ import annotations

from typing import Literal

from pydantic.dataclasses import dataclass

from worker.settings.task import STRICT, Amount


@dataclass(frozen=True, config=STRICT)
class ObstacleConfig:
    """A box on the road: 0.4 m long, 0.24 m wide, 0.2 m high."""

    distance: Amount = 0.0
    """Distance from the start line along the centre line, in the order of the waypoints [m]."""
    lane: Literal["inner", "center", "outer"] = "outer"
    """Middle of the inner or outer half of the road, or the centre line."""
