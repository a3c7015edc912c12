"""A cart-pole from a file that a test changes."""

from __future__ import annotations

from pathlib import Path

from tests.support.worker.broken_task import Rooted
from worker.settings.cartpole import CartpoleConfig
from worker.simulation.robot import Robot

TASK = f"{__name__}:Changing"


class Changing(Rooted):
    file: Path

    def robot(self, config: CartpoleConfig) -> Robot:
        return Robot(self.file, passive=True)
