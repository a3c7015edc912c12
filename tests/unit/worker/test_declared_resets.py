"""Declared tasks: what a world has forgotten of the episode before when it begins the next, and what a checkpoint keeps."""

from __future__ import annotations

import torch
import warp as wp

from tests.support.worker.declared import Sliders, SlidersConfig
from tests.support.worker.tasks import observe, put, statistics
from worker.simulation.objects import Box


class BesideACube(Sliders):
    """The sliders and a cube that no event places."""

    solver_options = {"njmax": 20, "nconmax": 10}

    def objects(self, config: SlidersConfig) -> dict[str, Box]:
        return {"cube": Box("cube", size=(0.1, 0.1, 0.1), position=(5.0, 6.0, 7.0))}


def test_a_world_that_failed_in_what_no_event_places_begins_where_the_model_has_it() -> None:
    task = BesideACube(SlidersConfig(), 2, seed=1)
    put(task)
    places, speeds = wp.to_torch(task.worlds.arrays.joint_q), wp.to_torch(task.worlds.arrays.joint_qd)
    places[0, -7:], speeds[0, -6:] = float("nan"), float("nan")
    untouched = places[1, -7:].clone()
    observe(task)
    assert statistics(task)["nan_worlds"] == 1.0
    assert places[0, -7:].tolist() == [5.0, 6.0, 7.0, 0.0, 0.0, 0.0, 1.0] and not speeds[0, -6:].any()
    assert torch.equal(places[1, -7:], untouched), "a world that goes on is left alone"
    for _ in range(3):
        task.step(torch.zeros_like(task.actions))
    assert statistics(task)["nan_worlds"] == 1.0
