"""Declared tasks: poses of bodies are those of the step in which a term of any section reads them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import pytest
import torch
import warp as wp

from tests.support.worker.declared import Sliders, SlidersConfig
from tests.support.worker.tasks import put
from worker.tasks import Action, BodyArrays, EpisodeArrays, Event, Observation, RobotArrays, Term, WorldArrays, terms
from worker.tasks.functions import reads_poses


@wp.func
def place_of_near(bodies: BodyArrays, world: int) -> float:
    return wp.transform_get_translation(bodies.poses[world, 0])[0]


@wp.func
def by_position(world: int, bodies: BodyArrays) -> float:
    return place_of_near(bodies, world)


@wp.func
def by_keyword(world: int, bodies: BodyArrays) -> float:
    return place_of_near(bodies=bodies, world=world)


@wp.func
def by_another_name(world: int, bodies: BodyArrays) -> float:
    the_same = bodies
    return wp.transform_get_translation(the_same.poses[world, 0])[0]


@wp.func
def centre_of_near(bodies: BodyArrays, world: int) -> float:
    return bodies.coms[world, 0][0]


@wp.func
def centre(world: int, bodies: BodyArrays) -> float:
    return centre_of_near(world=world, bodies=bodies) + centre_of_near(bodies, world)


clamp = wp.clamp


@wp.func
def clamped_centre(world: int, bodies: BodyArrays) -> float:
    return clamp(centre_of_near(bodies, world), 0.0, 1.0)


@wp.func
def note_place(world: int, bodies: BodyArrays, episodes: EpisodeArrays, lasting: int):
    episodes.lasting[world, lasting] = place_of_near(bodies, world)


@wp.func
def push_by_place(world: int, bodies: BodyArrays, worlds: WorldArrays, robot: RobotArrays, joint: int, value: float):
    worlds.controls[world, robot.actuators[joint]] = place_of_near(bodies, world)


@pytest.mark.parametrize(
    ("function", "reads"),
    [(by_position, True), (by_keyword, True), (by_another_name, True), (centre, False), (clamped_centre, False)],
)
def test_reads_of_poses_are_detected_in_the_source_of_a_function(function: Any, reads: bool) -> None:
    assert reads_poses(function) == reads


def test_functions_that_only_place_roots_read_no_pose() -> None:
    """Most tasks have such events, and would be slower if each step brought the bodies up to date for them."""
    for function in (terms.reset_root, terms.reset_to_default, terms.reset_root_on_terrain, terms.push):
        assert not reads_poses(function), function


def sliders(**sections: Mapping[str, Term]) -> Sliders:
    class Reading(Sliders):
        def sections(self) -> dict[str, Any]:
            return super().sections() | {"randomize": {}} | sections

    return Reading(SlidersConfig(), 2, seed=1)


def test_an_event_reads_the_poses_of_the_step() -> None:
    note = Event(note_place, when="interval", seconds=(0.1, 0.1), lasting=1)
    task = sliders(events={"note": note}, curricula={}, observations={"place": Observation(terms.joint_position)})
    put(task, joint_q=[[0.25, 0.0], [-0.5, 0.0]], joint_qd=[[1.0, 0.0], [1.0, 0.0]])
    for _ in range(3):
        task.step(torch.zeros_like(task.actions))
        noted = task.state_dict()["lasting"][:, -1]
        assert torch.allclose(noted, wp.to_torch(task.worlds.arrays.joint_q)[:, 0])
    assert noted[0] > 0.5, "it moves"


def test_an_action_reads_current_poses_of_reset_and_restored_worlds() -> None:
    task = sliders(actions={"force": Action(push_by_place, joints="first")})
    task.reset()
    for _ in range(2):
        before = wp.to_torch(task.worlds.arrays.joint_q)[:, 0].clone()
        task.step(torch.zeros_like(task.actions))
        assert torch.allclose(wp.to_torch(task.worlds.arrays.controls)[:, 0], before)
        put(task, joint_q=[[0.75, 0.0], [-0.5, 0.0]])
