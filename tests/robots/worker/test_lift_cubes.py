"""The arm that lifts one of several cubes, on the CPU: what it sees and is rewarded for is of the chosen cube alone, by hand."""

from __future__ import annotations

import math
from dataclasses import replace

import mujoco
import numpy as np
import pytest
import torch

from tests.robots.worker.test_lift import site
from tests.support.refusals import refusal
from tests.support.worker.lift_reference import HOME, reference, to_mujoco
from tests.support.worker.robots import needs_mjlab
from tests.support.worker.tasks import observe, play, played_twice, plays_like_its_part, put, same, statistics
from worker.learning.job import configure
from worker.settings.errors import UserError
from worker.settings.lift import LiftCubesConfig
from worker.simulation.objects import Box
from worker.tasks import ObjectSelection, find_task
from worker.tasks.library.lift_cubes import LiftCubes

pytestmark = needs_mjlab
WORLDS = 3
PLACES = np.array([[0.31, -0.07, 0.12], [0.36, 0.1, 0.02], [0.25, 0.05, 0.3]])
"""Where the three cubes are, in every world [m]."""
TARGET = np.array([0.4, 0.1, 0.25])
CHOICES = np.array([2, 0, 1])
"""Of each world."""


@pytest.fixture(scope="module")
def lift() -> LiftCubes:
    return LiftCubes(LiftCubesConfig(), WORLDS, seed=1)


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return reference()


def arranged(task: LiftCubes, places: np.ndarray) -> None:
    """Judge these places of the cubes, the arm being at home and each world having its own choice."""
    cubes = [number for place in places for number in (*place, 0.0, 0.0, 0.0, 1.0)]
    put(task, joint_q=[[*HOME, *cubes]] * WORLDS)
    state = task.state_dict()
    state["memory"][:, :3] = torch.tensor(TARGET, dtype=torch.float32)
    (chosen,) = [name for name in state if name.endswith("chosen")]
    state[chosen][:] = torch.eye(3)[CHOICES]
    task.load_state_dict(state)
    task.actions.zero_()
    observe(task)


def test_it_is_found_and_sees_the_chosen_cube_all_cubes_and_which_it_is(lift: LiftCubes) -> None:
    assert find_task("LiftCubes") is LiftCubes
    names = [f"{term}_{axis}" for term in ("ee_to_cube", "cube_to_goal") for axis in "xyz"]
    names += [f"cube_{cube}_ee_to_cubes_{axis}" for cube in range(3) for axis in "xyz"]
    names += [f"cube_{cube}_chosen" for cube in range(3)]
    assert lift.observation_names[16:34] == tuple(names) and lift.observation_shape == (41,)
    assert len(LiftCubes.sketch(LiftCubesConfig(cubes=5)).observation_names) == 41 + 2 * 4


def test_observations_and_rewards_are_those_of_the_chosen_cube_by_hand(lift: LiftCubes, model: mujoco.MjModel) -> None:
    arranged(lift, PLACES)
    hand, _ = site(model, to_mujoco(np.array([*HOME, *PLACES[0], 0.0, 0.0, 0.0, 1.0])))
    exact = lift.groups["critic"].numpy()[:, 16:34]
    for world, choice in enumerate(CHOICES):
        cube = PLACES[choice]
        expected = np.concatenate([cube - hand, TARGET - cube, (PLACES - hand).flatten(), np.eye(3)[choice]])
        assert np.allclose(exact[world], expected, atol=1e-5)
        reach, way = np.sum((cube - hand) ** 2), np.sum((TARGET - cube) ** 2)
        terms = {
            "lift": math.exp(-reach / 0.04) * (1.0 + math.exp(-way / 0.09)),
            "lift_precise": math.exp(-way / 0.0025),
        }
        sums = dict(zip(lift.reward_terms, lift.state_dict()["episode_sums"][world, 2:].tolist(), strict=False))
        for name, value in terms.items():
            assert sums[name] == pytest.approx(value / 50, abs=1e-6), (world, name)


def test_where_the_other_cubes_are_earns_nothing(lift: LiftCubes) -> None:
    arranged(lift, PLACES)
    before = lift.rewards.clone()
    assert len(torch.unique(before)) == WORLDS, "each world has another cube"
    for world, choice in enumerate(CHOICES):
        others = np.full((3, 3), TARGET)  # both of them at the target
        others[choice] = PLACES[choice]
        arranged(lift, others)
        assert torch.equal(lift.rewards[world], before[world])
        arranged(lift, np.where(np.arange(3)[:, None] == choice, TARGET, PLACES))
        assert lift.rewards[world] > before[world] + 0.01, "the chosen one at the target"


def test_every_cube_is_chosen_and_all_lie_apart_in_their_ranges() -> None:
    config = LiftCubesConfig(command_seconds=(0.02, 0.02), cube_z=(0.3, 0.4))
    task = LiftCubes(config, WORLDS, seed=2)
    task.reset()
    chosen, places, targets = [], [], []
    for _ in range(80):  # a new command in each step
        task.step(torch.zeros(WORLDS, 7))
        exact = task.groups["critic"].numpy()
        rows = task.worlds.arrays.joint_q.numpy()[:, 8:].reshape(WORLDS, 3, 7).copy()
        index = exact[:, 31:34].argmax(axis=1)
        assert (exact[:, 31:34].sum(axis=1) == 1.0).all() and (task.worlds.arrays.joint_qd.numpy()[:, 8:] == 0).all()
        aims = task.state_dict()["memory"][:, :3].numpy().copy()
        to_goal = aims - rows[np.arange(WORLDS), index, :3]
        assert np.allclose(exact[:, 19:22], to_goal, atol=1e-6), "the chosen one, where it is now"
        chosen += list(index)
        places += list(rows[:, :, :3])
        targets += list(aims)
    counts = np.bincount(chosen, minlength=3)
    assert (np.abs(counts - 80) < 30).all(), "240 draws: four deviations of 7.3"
    found = np.array(places)
    for axis, (least, greatest) in enumerate(((0.25, 0.4), (-0.15, 0.15), (0.3, 0.4))):
        assert (found[..., axis] >= least).all() and (found[..., axis] <= greatest).all()
        assert (np.ptp(found[..., axis], axis=0) > 0.8 * (greatest - least)).all()
    gaps = np.linalg.norm(found[:, :, None, :2] - found[:, None, :, :2], axis=-1)[:, *np.triu_indices(3, 1)]
    assert gaps.min() >= 0.06 and gaps.min() < 0.08
    assert np.ptp(np.array(targets)[:, 2]) > 0.15


def test_cubes_that_do_not_fit_beside_one_another_are_put_above_them() -> None:
    task = LiftCubes(LiftCubesConfig(cube_x=(0.3, 0.3), cube_y=(0.0, 0.0)), WORLDS, seed=2)
    task.reset()
    heights = task.worlds.arrays.joint_q.numpy()[:, 8:].reshape(WORLDS, 3, 7)[:, :, 2]
    assert (np.diff(heights, axis=1) >= 0.06 - 1e-6).all() and (heights[:, 0] <= 0.05).all()


def test_it_goes_on_bit_for_bit_and_worlds_do_not_know_their_rank(lift: LiftCubes) -> None:
    task = LiftCubes(LiftCubesConfig(episode_seconds=0.3, command_seconds=(0.1, 0.15)), 3, seed=5)
    first, again = played_twice(task)
    assert torch.cat([step[2] for step in first]).any(), "an episode ended"
    assert same(first, again)

    part = LiftCubes(LiftCubesConfig(), 2, seed=1, first_world=1)
    assert plays_like_its_part(lift, part)


def test_random_ones_stay_finite_within_the_solvers_capacity() -> None:
    task = LiftCubes(LiftCubesConfig(cube_x=(0.25, 0.28), cube_y=(0.0, 0.03)), WORLDS, seed=1)
    task.reset()  # they fall on one another
    steps = play(task, 100, seed=2)
    assert all(step[0].isfinite().all() and step[1].isfinite().all() for step in steps)
    totals = statistics(task)
    assert totals["solver_overflows"] == 0 and totals["nan_worlds"] == 0


def test_impossible_settings_are_refused_in_one_line() -> None:
    for cubes, problem in ((0, "greater than or equal to 1, found 0"), (7, "less than or equal to 6, found 7")):
        output = refusal(configure, LiftCubes, {"config": {"cubes": cubes}}, error=UserError)
        assert output.startswith(f"train.config.cubes: expected a value {problem}")


def test_a_selection_of_missing_or_fixed_parts_is_refused_in_one_line() -> None:
    class Wrong(LiftCubes):
        selected = "cubs"

        def objects(self, config: LiftCubesConfig) -> dict[str, Box]:
            found = dict(super().objects(config))
            return {**found, "shelf": Box("shelf", size=(0.1, 0.1, 0.1), position=(0.0, 0.5, 0.05), fixed=True)}

        def declare(self, config: LiftCubesConfig):
            declared = super().declare(config)
            return replace(declared, sensors={**declared.sensors, "cubes": ObjectSelection(self.selected)})

    output = refusal(Wrong.sketch, LiftCubesConfig())
    assert "sensors.cubes: no object matches 'cubs'; " in output and "available: robot, cube_0" in output
    Wrong.selected = "s*"
    fixed = "sensors.cubes: ObjectSelection: shelf is fixed to the world; leave it out"
    assert fixed in refusal(Wrong.sketch, LiftCubesConfig())
