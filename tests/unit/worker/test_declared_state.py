"""Tasks: poses are those of the step in which a term reads them; what a reset forgets, and what a checkpoint keeps."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import pytest
import torch
import warp as wp

from tests.support.worker.declared import MODEL, Sliders, SlidersConfig
from tests.support.worker.tasks import observe, put, statistics
from worker.simulation.objects import Box
from worker.tasks import (
    Action,
    BodyArrays,
    EpisodeArrays,
    Event,
    Metric,
    Observation,
    Randomization,
    Robot,
    RobotArrays,
    Term,
    WorldArrays,
    terms,
)
from worker.tasks.declare.functions import reads_poses


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


def test_a_factor_of_a_job_is_on_all_robots_and_objects() -> None:
    plain, heavy = (
        BesideACube(SlidersConfig(randomize=Randomization(mass=(factor, factor))), 1, seed=1) for factor in (1.0, 2.0)
    )
    masses = [task.worlds.solver.mjw_model.body_mass.numpy()[0, 1:] for task in (plain, heavy)]
    assert len(masses[0]) == 3 and masses[1] == pytest.approx(2.0 * masses[0], rel=1e-5)
    assert heavy.randomizations is not None and heavy.randomizations.names == ["mass/near", "config_mass"]


class Filtered(Sliders):
    """The first slider's force follows its control as a low-pass filter of 0.5 s does."""

    def robot(self, config: SlidersConfig) -> Robot:
        motor = '<motor joint="first" gear="2"/>'
        filtered = '<general joint="first" dyntype="filter" dynprm="0.5" gainprm="10"/>'
        return Robot(MODEL.replace(motor, filtered))

    def sections(self) -> dict[str, Any]:
        return super().sections() | {"actions": {"force": Action(terms.effort)}, "randomize": {}}


def test_activations_of_actuators_are_part_of_the_state_and_cleared_at_a_reset() -> None:
    task, other = Filtered(SlidersConfig(), 2, seed=1), Filtered(SlidersConfig(), 2, seed=1)
    activations = wp.to_torch(task.worlds.solver.mjw_data.act)
    assert not activations.any(), "the step that tries out the graph leaves nothing"
    task.step(torch.ones_like(task.actions))
    # one explicit step of 0.1 s: 0 + 0.1 * (1 - 0) / 0.5
    assert activations.flatten().tolist() == pytest.approx([0.2, 0.2])
    other.load_state_dict(task.state_dict())
    assert torch.equal(wp.to_torch(other.worlds.solver.mjw_data.act), activations)
    for each in (task, other):
        each.step(torch.ones_like(each.actions))
    assert torch.equal(task.observations, other.observations)
    older = {name: tensor for name, tensor in task.state_dict().items() if name != "activations"}
    other.load_state_dict(older)
    assert not wp.to_torch(other.worlds.solver.mjw_data.act).any()
    task.reset()
    assert not activations.any()
    assert "activations" not in BesideACube(SlidersConfig(), 1).state_dict(), "where no actuator has any"


@wp.func
def root_of_place(world: int, worlds: WorldArrays, robot: RobotArrays, joint: int) -> float:
    return wp.sqrt(worlds.joint_q[world, robot.coordinates[joint]])


class Measured(Sliders):
    """A metric that is not a number to the left of 0, and what slides and turns in one robot."""

    def robot(self, config: SlidersConfig) -> Robot:
        return Robot(MODEL.replace('name="second" type="slide"', 'name="second" type="hinge"'))

    def sections(self) -> dict[str, Any]:
        sections = super().sections() | {"actions": {"force": Action(terms.effort)}}
        return sections | {"metrics": {"root": Metric(root_of_place, joints="first")}}


def test_a_metric_that_is_not_finite_counts_0_in_that_step() -> None:
    task = Measured(SlidersConfig(), 2, seed=1)
    column = task.statistic_names.index("metric_root") - 1  # sums begin with the return, after the count of episodes
    put(task)
    for place in (-0.25, 0.25):
        wp.to_torch(task.worlds.arrays.joint_q)[:, 0] = place
        observe(task)
    assert task.state_dict()["episode_sums"][:, column].tolist() == pytest.approx([0.5, 0.5])


def test_the_unit_of_an_action_is_that_of_its_joint() -> None:
    task = Measured(SlidersConfig(), 1)
    assert [action.unit for action in task.interface().actions] == ["N", "N m"]
