"""Cars in small worlds, and what the device knows of them."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from racer.car.task import Racer
from racer.settings.task import RacerConfig
from racer.tracks.presets import make_preset
from racer.tracks.race_track import Track

OVAL = make_preset("oval")


def round_the_guard(source: str, file: str = "r.py") -> str:
    """A reward function with all built-in functions and modules of Python, as one gets at them who wants to."""
    return (
        "import random\n__builtins__ = random.Random.seed.__globals__['__builtins__']\n"
        f"__builtins__['exec'](__builtins__['compile']({source!r}, {file!r}, 'exec'), (lambda: 0).__globals__)\n"
    )


def racer(worlds: int = 1, **fields: Any) -> Racer:
    return Racer(RacerConfig(start=fields.pop("start", "line"), **fields), worlds, seed=3)


def known(task: Racer, name: str) -> np.ndarray:
    """A copy of one of the car's arrays."""
    found: np.ndarray = getattr(task.sensors["car"].arrays, name).numpy().copy()
    return found


def counted(task: Racer, name: str) -> float:
    return float(task.statistics[task.statistic_names.index(name)])


def ahead(task: Racer, speed: float = 0.0) -> torch.Tensor:
    """Actions that steer for the third point ahead."""
    column = task.observation_names.index("waypoint_2_x")
    x, y = task.observations[:, column], task.observations[:, column + 1]
    return torch.stack((torch.atan2(y, x) / 0.5236, torch.full_like(x, speed)), 1)


def straight(task: Racer, speed: float = 0.0) -> torch.Tensor:
    """Actions of cars that do not steer."""
    return torch.tensor([[0.0, speed]] * task.world_count)


def open_track() -> Track:
    """Half an oval, driven from its start line to the end of its second straight, to the left: 12 m or so, 1 m wide."""
    rows = slice(0, 80)
    return Track("horseshoe", OVAL.center[rows], OVAL.inner[rows], OVAL.outer[rows], closed=False)
