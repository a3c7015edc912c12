"""Worlds that differ: what the solver holds of each, what happens to them, what is refused. Resume: test_resume.py."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
import warp as wp

from tests.support.refusals import refusal
from tests.support.worker.tasks import observe, play, put, same
from worker.learning.job import configure
from worker.settings.errors import UserError
from worker.settings.task import FACTORS, Randomization
from worker.tasks.library.ant import Ant, AntConfig
from worker.tasks.library.cartpole import Cartpole, CartpoleConfig
from worker.tasks.library.quadruped import Quadruped, QuadrupedConfig
from worker.tasks.run.task import Task

ALL = Randomization(mass=(0.5, 2.0), friction=(0.5, 1.25), damping=(0.5, 3.0), gains=(0.8, 1.2), gravity=(0.9, 1.1))
POSE = [0.0, 0.0, 3.0, 0.0, 0.0, 0.0, 1.0, *[0.0, 0.8, -1.6] * 4]


@pytest.fixture(scope="module")
def plain() -> Quadruped:
    return Quadruped(QuadrupedConfig(), 8, seed=1)


@pytest.fixture(scope="module")
def differing() -> Quadruped:
    return Quadruped(QuadrupedConfig(randomize=ALL), 8, seed=1)


def factors(task: Task) -> dict[str, np.ndarray]:
    """The factors of each world, by name."""
    assert task.randomizations is not None
    names = [name.partition("/")[0].removeprefix("config_") for name in task.randomizations.names]
    return dict(zip(names, task.randomizations.draws.numpy().T, strict=True))


def test_the_solver_holds_of_each_world_what_was_drawn(plain: Quadruped, differing: Quadruped) -> None:
    drawn = factors(differing)
    before, after = plain.worlds.solver.mjw_model, differing.worlds.solver.mjw_model
    assert tuple(drawn) == FACTORS and factors(plain) == {}
    for name, values in drawn.items():
        least, greatest = getattr(ALL, name)
        assert len(set(values)) == 8 and (values >= least).all() and (values <= greatest).all()
        assert values.min() < least + 0.4 * (greatest - least) and values.max() > greatest - 0.4 * (greatest - least)

    def numbers(model: Any, name: str) -> np.ndarray:
        """Of each world; the principal axes of an inertia may come in another order."""
        return np.sort(getattr(model, name).numpy()).reshape(8, -1)

    def ratio(name: str) -> np.ndarray:
        old, new = numbers(before, name), numbers(after, name)
        assert np.array_equal(old == 0, new == 0)
        return np.divide(new, old, out=np.ones_like(new), where=old != 0)

    for names, factor in (
        (("body_mass", "body_inertia", "body_subtreemass"), "mass"),
        (("geom_friction",), "friction"),
        (("dof_damping",), "damping"),
        (("actuator_gainprm", "actuator_biasprm"), "gains"),
    ):
        for name in names:
            change = ratio(name)
            scaled = numbers(before, name) != 0
            assert scaled.any()
            assert np.allclose(change[scaled], (drawn[factor][:, None] * np.ones_like(change))[scaled], rtol=1e-5), name
    assert np.allclose(after.opt.gravity.numpy()[:, 2], -9.81 * drawn["gravity"])
    # what the solver derives from masses: a heavier trunk is harder to move, in proportion but for the rotors' inertia
    weights = [model.body_invweight0.numpy()[:, 1, 0] for model in (before, after)]
    heavier = weights[1] / weights[0]
    assert np.allclose(heavier * drawn["mass"], 1.0, atol=0.02)


def test_worlds_fall_as_their_gravity_says_and_motors_push_as_their_gains(differing: Quadruped) -> None:
    put(differing, joint_q=[POSE] * 8, joint_qd=[[0.0] * 18] * 8)
    differing.step(torch.zeros(8, 12))
    gravity = torch.from_numpy(factors(differing)["gravity"])
    assert torch.allclose(differing.observations[:, 2], -9.81 / 50 * gravity, rtol=0.01), "in free fall for 0.02 s"

    ant = Ant(AntConfig(randomize={"gains": [0.5, 2.0]}), 4, seed=1)
    ant.step(0.5 * torch.ones(4, 8))
    gains = torch.from_numpy(factors(ant)["gains"])
    assert torch.allclose(wp.to_torch(ant.worlds.arrays.drives)[:, 6:], 0.5 * 15.0 * gains[:, None].expand(4, 8))


def test_what_a_world_is_like_depends_on_its_seed_and_global_index_alone(differing: Quadruped) -> None:
    drawn = factors(differing)
    for first in (0, 4):
        half = Quadruped(QuadrupedConfig(randomize=ALL), 4, seed=1, first_world=first)
        assert all((own == drawn[name][first : first + 4]).all() for name, own in factors(half).items())
        for name in ("body_mass", "geom_friction", "dof_damping", "actuator_gainprm"):
            whole = getattr(differing.worlds.solver.mjw_model, name).numpy()[first : first + 4]
            assert np.array_equal(getattr(half.worlds.solver.mjw_model, name).numpy(), whole), name
    alone = factors(Quadruped(QuadrupedConfig(randomize={"gains": ALL.gains}), 8, seed=1))
    assert [*alone] == ["gains"] and (alone["gains"] == drawn["gains"]).all(), "whatever else is drawn"
    other = factors(Quadruped(QuadrupedConfig(randomize=ALL), 8, seed=2))
    assert not any((other[name] == drawn[name]).any() for name in FACTORS)


def test_a_disabled_randomisation_changes_nothing_and_draws_nothing(plain: Quadruped) -> None:
    put(plain)
    streams = plain.state_dict()["random"][:, 2].clone()
    plain.step(torch.zeros(8, 12))
    assert not plain.dones.any() and torch.equal(plain.state_dict()["random"][:, 2], streams)
    assert not plain.state_dict().keys() & {"randomization_draws", "control_delays", "control_history"}
    put(plain)
    history = play(plain, 20, seed=3)
    put(plain)
    assert same(history, play(plain, 20, seed=3))


def test_pushes_come_at_random_with_the_mean_that_was_asked_for() -> None:
    settings = {
        "randomize": {"push_interval": 0.1, "push_velocity": 0.5},
        "episode_seconds": 100.0,
        "fall_height": -9.0,
    }
    task = Ant(AntConfig(**settings), 64, seed=1)
    velocities, moved = wp.to_torch(task.worlds.arrays.joint_qd), list[torch.Tensor]()
    task.move = lambda: moved.append(velocities.clone())  # type: ignore[method-assign]
    changes = []
    for _ in range(60):
        for _, part in task._control.parts():
            part()
        changes.append(velocities - moved[-1])
    changed = torch.stack(changes)
    assert not changed[..., 2:].any(), "pushes are horizontal"
    pushed = changed[..., :2].any(dim=2)
    # one in 6 steps of 1/60 s: 640 of 3840, with a standard deviation of 23
    assert 550 < pushed.sum() < 730
    pushes = changed[..., :2][pushed]
    assert pushes.abs().max() <= 0.5001 and pushes.abs().max() > 0.45 and abs(pushes.mean()) < 0.03
    assert pushed.sum(dim=0).min() > 0 and len({tuple(world.tolist()) for world in pushed.T}) == 64


def test_noise_has_its_deviation_and_leaves_the_simulation_alone() -> None:
    clean = Cartpole(CartpoleConfig(), 256, seed=1)
    noisy = Cartpole(CartpoleConfig(randomize={"observation_noise": 0.2}), 256, seed=1)
    for task in (clean, noisy):
        put(task, joint_q=[[0.0, 0.5]] * 2)  # two fall at once
        task.actions.zero_()
        observe(task)
    noise = (noisy.observations - clean.observations)[2:]
    assert torch.equal(wp.to_torch(noisy.worlds.arrays.joint_q)[2:], wp.to_torch(clean.worlds.arrays.joint_q)[2:])
    assert abs(noise.mean()) < 0.03 and noise.std().item() == pytest.approx(0.2, rel=0.08)
    assert torch.equal(noisy.rewards, clean.rewards)
    terminal = (noisy.terminal_observations - clean.terminal_observations)[:2]
    assert terminal.all() and terminal.abs().max() < 1.0
    noisy.reset()
    assert not torch.equal(noisy.observations[:, 0], wp.to_torch(noisy.worlds.arrays.joint_q)[:, 0])


def test_controls_are_late_by_each_episode_s_latency() -> None:
    task = Quadruped(QuadrupedConfig(randomize={"action_latency": 3}, action_scale=1.0, stand_thigh=0.0), 64, seed=1)
    requested, supplied = [], []
    for step in range(8):
        task.step(torch.full((64, 12), 0.1 * step))
        assert not task.dones.any()
        requested.append(0.1 * step)
        supplied.append(wp.to_torch(task.worlds.arrays.controls)[:, 1].clone())
    delays = task.state_dict()["control_delays"]
    assert set(delays.tolist()) == {0, 1, 2, 3}
    for world, delay in enumerate(delays.tolist()):
        expected = [requested[max(0, step - delay)] for step in range(8)]
        assert [values[world].item() for values in supplied] == pytest.approx(expected, abs=1e-6)
    assert torch.allclose(task.observations[:, 36:], torch.tensor(0.7)), "the policy sees what it asked for"
    task.reset()
    task.step(torch.full((64, 12), -0.5))
    supplied = wp.to_torch(task.worlds.arrays.controls)[:, 1]
    assert torch.allclose(supplied, torch.tensor(-0.5)), "nothing of the old episode"
    assert not torch.equal(task.state_dict()["control_delays"], delays)


def test_a_state_brings_the_physics_of_its_worlds_also_that_of_an_older_version(differing: Quadruped) -> None:
    other = Quadruped(QuadrupedConfig(randomize=ALL), 8, seed=2)
    state = differing.state_dict()
    draws = state["randomization_draws"]
    for saved in (
        state,
        {**{key: each for key, each in state.items() if "randomization" not in key}, "world_factors": draws},
    ):
        other.restart(2, 0)
        assert not torch.equal(other.state_dict()["randomization_draws"], draws)
        other.load_state_dict(saved)
        assert torch.equal(other.state_dict()["randomization_draws"], draws)
        masses = [task.worlds.solver.mjw_model.body_mass.numpy() for task in (other, differing)]
        assert np.array_equal(*masses)


@pytest.mark.parametrize(
    ("randomize", "message"),
    [
        ({"mass": 2}, ".mass: expected [least, greatest], two factors above 0, found 2"),
        ({"mass": [2, 1]}, ".mass: expected [least, greatest], two factors above 0, found [2, 1]"),
        ({"gains": [-1, 1]}, ".gains: expected [least, greatest], two factors of 0 or more"),
        ({"friction": [0, math.inf]}, ".friction: expected [least, greatest], two factors"),
        ({"friction": [0, "much"]}, ".friction: expected [least, greatest], two factors of 0 or more"),
        ({"observation_noise": -1}, ".observation_noise: expected a number of 0 or more, found -1"),
        ({"action_latency": 100}, ".action_latency: expected a value less than or equal to 64, found 100"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(randomize: object, message: str) -> None:
    output = refusal(configure, Ant, {"config": {"randomize": randomize}}, error=UserError)
    assert output.startswith(f"train.config.randomize{message}")


def test_a_robot_that_is_fixed_is_not_pushed() -> None:
    with pytest.raises(ValueError, match=r"randomize.push_velocity: the robot is fixed to the world"):
        Cartpole(CartpoleConfig(randomize={"push_interval": 1.0, "push_velocity": 1.0}), 2)
    with pytest.raises(ValueError, match=r"^randomize.mas: Unexpected keyword argument"):
        CartpoleConfig(randomize={"mas": [1, 2]})
