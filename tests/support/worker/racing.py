"""Cars in small worlds, and what the device knows of them."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from worker.racer.presets import make_preset
from worker.tasks.configs.racer import RacerConfig
from worker.tasks.racer import Racer

OVAL = make_preset("oval")
ROUND_THE_GUARD = """import random
real = random.Random.seed.__globals__["__builtins__"]
open = real["open"]
os = real["__import__"]("os")
"""
"""First lines of a reward function that gets at files and the system, as one does who wants to."""


def racer(worlds: int = 1, **fields: Any) -> Racer:
    return Racer(RacerConfig(start=fields.pop("start", "line"), **fields), worlds, seed=3)


def known(task: Racer, name: str) -> np.ndarray:
    """A copy of one of the car's arrays."""
    found: np.ndarray = getattr(task.sensors["car"].arrays, name).numpy().copy()
    return found


def counted(task: Racer, name: str) -> float:
    return float(task.statistics[task.statistic_names.index(name)])


def straight(task: Racer, speed: float = 0.0) -> torch.Tensor:
    """Actions of cars that do not steer."""
    return torch.tensor([[0.0, speed]] * task.world_count)
