"""The racer's tasks continue bit for bit in a fresh process."""

from __future__ import annotations

from pathlib import Path

import torch

from tests.support.worker.fresh_process import Settings, goes_on_in_a_fresh_process

torch.set_num_threads(1)
SETTINGS: Settings = {
    "Racer": {
        "episode_seconds": 2.0,
        "track": ["oval", "random:4"],
        "alternate_direction": True,
        "speed_factor": [0.8, 1.2],
        "obstacles": [{"distance": 3.0}],
        "continuous": True,
        "randomize": {"action_latency": 2},
    },
    "RacerPixels": {"episode_seconds": 2.0, "front": {"width": 32, "height": 24, "frames": 2}},
    "RacerPixelsAndState": {"episode_seconds": 2.0, "front": {"width": 32, "height": 24}},
}
"""Episodes are short, for resets before and after each point."""


def test_a_fresh_process_goes_on_bit_for_bit(tmp_path: Path) -> None:
    goes_on_in_a_fresh_process(SETTINGS, tmp_path)
