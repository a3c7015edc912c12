"""A task for tests: Cartpole that writes down the worlds with which it goes on."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

import torch

from worker.tasks.library.cartpole import Cartpole


class Recorded(Cartpole):
    """Writes ``$RECORDED/<epoch>-<first world>.pt`` when its worlds are loaded for the first time."""

    recorded = False

    def load_state_dict(self, state: Mapping[str, torch.Tensor]) -> None:
        super().load_state_dict(state)
        if not self.recorded:
            path = Path(os.environ["RECORDED"]) / f"{os.environ['MUSTER_EPOCH']}-{self.first_world}.pt"
            torch.save(self.state_dict(), path)
            self.recorded = True
