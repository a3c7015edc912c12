"""What changes in the course of training: weights and the level, from the YAML and from a task's own hook."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch

from tests.support.refusals import refusal
from tests.support.worker.ranks import training
from tests.support.worker.runs import train
from tests.support.worker.tasks import observe, put
from worker.learning.job import configure
from worker.settings.errors import UserError
from worker.settings.task import value_at
from worker.tasks.library.ant import Ant
from worker.tasks.library.cartpole import Cartpole, CartpoleConfig
from worker.tasks.library.quadruped import Quadruped, QuadrupedConfig


def test_between_its_points_a_value_changes_in_proportion() -> None:
    points = [[10, 1.0], [20, 3.0], [30, 0.0]]
    assert [value_at(points, n) for n in (0, 10, 15, 20, 25, 30, 99)] == [1.0, 1.0, 2.0, 3.0, 1.5, 0.0, 0.0]
    assert value_at([[5, 0.5]], 0) == value_at([[5, 0.5]], 9) == 0.5


def test_a_weight_follows_the_iteration() -> None:
    task = Cartpole(CartpoleConfig(rewards={"alive": 1.0}, curriculum={"alive": [[0, 2.0], [10, 4.0]]}), 1, seed=1)
    for iteration, alive in ((0, 2.0), (5, 3.0), (50, 4.0)):
        task.begin_iteration(iteration, None, None)
        put(task, joint_q=[[0.0, 0.0]], joint_qd=[[0.0, 0.0]])
        task.actions.zero_()
        observe(task)
        assert task.rewards[0].item() == pytest.approx(alive)


def test_the_level_scales_the_quadrupeds_commands() -> None:
    config = QuadrupedConfig(curriculum={"level": [[0, 0.0], [100, 1.0]]}, command_stand=0.0)
    task = Quadruped(config, 16, seed=1)

    def commands(iteration: int) -> torch.Tensor:
        task.begin_iteration(iteration, 1.0, 2.0)
        task.seed(1)
        task.reset()
        return task.observations[:, 9:12].clone()

    whole = commands(100)
    assert not commands(0).any() and whole.abs().max() > 0.5
    torch.testing.assert_close(commands(25), 0.25 * whole)


@pytest.mark.parametrize(
    ("curriculum", "message"),
    [
        ({"forward": [[-1, 1.0]]}, "curriculum.forward: an iteration is a whole number from 0 up, found [[-1, 1.0]]"),
        ({"forward": [[2.5, 1.0]]}, "curriculum.forward: an iteration is a whole number from 0 up"),
        ({"forward": [[0, "x"]]}, "curriculum.forward: expected points [iteration, value], found [[0, 'x']]"),
    ],
)
def test_a_curriculum_that_cannot_be_is_refused_in_one_line(curriculum: Any, message: str) -> None:
    assert f"train.config.{message}" in refusal(configure, Ant, {"config": {"curriculum": curriculum}}, error=UserError)


def test_a_tasks_own_hook_is_called_before_every_iteration_and_goes_on_after_a_restart(tmp_path: Path) -> None:
    calls: list[tuple[int, float | None, float | None]] = []

    class Watched(Cartpole):
        def begin_iteration(self, iteration: int, reward: float | None, episode_length: float | None) -> None:
            super().begin_iteration(iteration, reward, episode_length)
            calls.append((iteration, reward, episode_length))

    for iterations, epoch in ((2, 1), (4, 2)):
        train(training(tmp_path, iterations=iterations, epoch=epoch, worlds=8, task="Cartpole"), task=Watched)
    # before each iteration, and before the evaluation at the end, which is of the last one's task
    assert [call[0] for call in calls] == [0, 1, 1, 2, 3, 3] and calls[0][1] is None
    assert calls[-1][1] is not None and calls[-1][2] > 1
