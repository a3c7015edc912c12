"""The racer's tasks on a GPU: capture, silence of the host, and rows of a rollout."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch

from tests.support.worker.on_device import has_a_row_for_each_step, iterates_without_waiting

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")

CASES: dict[str, tuple[str, dict[str, Any]]] = {
    "a car that no physics moves": ("Racer", {}),
    "a car that slides and chooses": (
        "Racer",
        {
            "config": {
                "friction": [0.4, 0.9],
                "action_space": {
                    "action_space": [{"steering_angle": angle, "speed": 2.0} for angle in (-30, 0, 30)],
                    "action_space_type": "discrete",
                },
            }
        },
    ),
    "cars of which each step is logged": ("Racer", {"config": {"sim_trace": 16}}),
    "a camera on a car": ("RacerPixels", {"config": {"front": {"width": 64, "height": 64}}}),
}


@pytest.mark.parametrize("case", CASES)
def test_an_iteration_is_a_few_graphs_and_never_waits_for_the_device(tmp_path: Path, case: str) -> None:
    iterates_without_waiting(tmp_path, *CASES[case])


@pytest.mark.parametrize("case", ["a car that slides and chooses", "a camera on a car"])
def test_each_control_step_of_a_rollout_is_one_row_however_late_the_device_is(tmp_path: Path, case: str) -> None:
    has_a_row_for_each_step(tmp_path, *CASES[case])
