"""Every task continues bit for bit: in a fresh process, and with its worlds distributed over another number of ranks."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from tests.support.worker.fresh_process import Settings, goes_on_in_a_fresh_process, make
from tests.support.worker.tasks import play, same
from worker.tasks.run.find import BUILT_IN

torch.set_num_threads(1)
SETTINGS: Settings = {
    "Cartpole": {},
    "CartpolePixels": {},
    "Ant": {"episode_seconds": 0.5},
    "Humanoid": {"episode_seconds": 0.5},
    "Quadruped": {"episode_seconds": 0.5, "command_seconds": 0.14},
    "Quadruped in random worlds": {
        "episode_seconds": 0.5,
        "randomize": {
            **{name: [0.8, 1.25] for name in ("mass", "friction", "damping", "gains", "gravity")},
            "push_interval": 0.1,
            "push_velocity": 1.0,
            "observation_noise": 0.1,
            "action_latency": 3,
        },
    },
}
"""Episodes and commands are short, for resets and new commands before and after each point."""


def test_every_built_in_task_is_tested() -> None:
    """Those of real robots and the arm in tests/robots."""
    robots = {"Go1Flat", "Go1Rough", "G1Flat", "G1Rough", "LiftCube", "LiftCubes"}
    assert SETTINGS.keys() | robots >= BUILT_IN.keys()


def test_a_fresh_process_goes_on_bit_for_bit(tmp_path: Path) -> None:
    goes_on_in_a_fresh_process(SETTINGS, tmp_path)


@pytest.mark.parametrize("name", ["Cartpole", "Quadruped in random worlds"])
def test_worlds_are_the_same_however_they_are_dealt_out(name: str) -> None:
    tasks = [make(SETTINGS, name), *(make(SETTINGS, name, 4, first_world=first) for first in (0, 4))]
    for task in tasks:
        task.set_random_episode_length()
    ages = tasks[0].episode_length.clone()
    assert torch.equal(ages, torch.cat([part.episode_length for part in tasks[1:]]))
    assert len(set(ages.tolist())) > 4 and (ages >= 0).all() and (ages < tasks[0].max_episode_length).all()
    whole, *parts = (play(task, 120, seed=6) for task in tasks)
    joined = [tuple(torch.cat(pair) for pair in zip(*steps, strict=True)) for steps in zip(*parts, strict=True)]
    assert same(whole, joined)
    assert sum(int(step[2].sum()) for step in whole) > 8, "resets were compared, too"
    assert not same(whole, play(make(SETTINGS, name, seed=2), 120, seed=6))


def test_what_a_task_keeps_from_step_to_step_belongs_to_the_state() -> None:
    task = make(SETTINGS, "Quadruped")
    play(task, 20, seed=7)
    state = task.state_dict()
    assert state["memory"].shape == (8, 4) and state["last_actions"].any()
    exact = play(task, 10, seed=8)
    task.load_state_dict(state | {"memory": state["memory"] * 0.5})
    assert not same(exact, play(task, 10, seed=8))
    task.load_state_dict(state)
    assert same(exact, play(task, 10, seed=8))
    assert "memory" not in make(SETTINGS, "Cartpole", 2).state_dict(), "a task that keeps nothing saves nothing"
