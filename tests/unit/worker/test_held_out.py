"""How a training judges what it learns: the score by which checkpoints are compared, and the worlds of its evaluation."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch

from shared_store.volume.checkpoints import list_checkpoints
from shared_store.volume.epoch import raise_epoch
from shared_store.volume.layout import Store
from tests.support.worker.loop import alone
from tests.support.worker.ranks import training
from tests.support.worker.runs import train
from worker.evaluation.evaluation import evaluate
from worker.evaluation.final_evaluation import held_out_worlds
from worker.learning.job import Job, StopRequest
from worker.learning.loop import Loop
from worker.learning.state import EndedEpisodes, Progress
from worker.learning.training import Training
from worker.tasks.library.cartpole import Cartpole


def scores(iterations: list[tuple[int, float]], **settings: int) -> list[float | None]:
    """The score after each iteration of 10 steps, of (episodes that ended, their mean return)."""
    progress, found = Progress(), []
    for episodes, mean in iterations:
        progress.count(EndedEpisodes(10, episodes, episodes * mean, episodes * mean**2), **settings)
        found.append(progress.score)
    return found


@pytest.mark.parametrize(
    ("iterations", "worlds", "longest", "expected"),
    [
        # episodes take up to 40 steps: what ends in the first 30 are falls, which alone make no score
        ([(200, 1.0)] * 3 + [(400, 21.0)], 100, 40, [None, None, None, 9.0]),
        ([(150, 1.0), (150, 3.0)], 300, 10, [None, 2.0]),
        ([(4, 1.0)] * 24 + [(4, 26.0)], 4, 10, [None] * 24 + [2.0]),
    ],
)
def test_a_score_covers_an_episode_of_each_world_and_a_hundred_in_all(
    iterations: list[tuple[int, float]], worlds: int, longest: int, expected: list[float | None]
) -> None:
    assert scores(iterations, worlds=worlds, longest=longest) == pytest.approx(expected)


def test_a_score_has_a_standard_error(tmp_path: Path) -> None:
    returns = torch.randn(4, 75, generator=torch.Generator().manual_seed(1), dtype=torch.float64) * 3.0 + 800.0
    progress = Progress()
    for part in returns:
        progress.count(
            EndedEpisodes(10, len(part), float(part.sum()), float(part.square().sum())), worlds=200, longest=10
        )
    covered = returns[1:].flatten()  # the newest iterations that have an episode of each world
    assert progress.score_episodes == 225 and progress.score == pytest.approx(float(covered.mean()))
    assert progress.score_error == pytest.approx(float(covered.std()) / 225**0.5, rel=1e-6)


def test_a_score_with_old_records_without_squares_has_no_error_until_they_expire() -> None:
    progress = Progress(recent=[[10, 100, 100.0]])  # as Muster saved it before
    found = []
    for _ in range(3):
        progress.count(EndedEpisodes(10, 100, 100.0, 100.0), worlds=100, longest=20)
        found.append((progress.score, progress.score_error))
    assert found == [(1.0, None), (1.0, 0.0), (1.0, 0.0)]
    for _ in range(1000):
        progress.count(EndedEpisodes(10, 50, 50.0, 50.0), worlds=100, longest=40)
    assert len(progress.recent) == 4, "only what the score needs is kept"


def test_the_manifest_has_the_score_and_a_resumed_run_the_same(tmp_path: Path) -> None:
    train(training(tmp_path, run="straight", worlds=64, iterations=8))
    train(training(tmp_path, run="stopped", worlds=64, iterations=5))
    train(training(tmp_path, run="stopped", worlds=64, iterations=8, epoch=2))
    straight, stopped = (list_checkpoints(Store(tmp_path).run(name))[-1].manifest for name in ("straight", "stopped"))
    assert isinstance(straight["score"], float) and straight["score"] == stopped["score"] != straight["reward"]
    assert straight["score_error"] == stopped["score_error"] > 0.0
    assert straight["score_episodes"] == stopped["score_episodes"] >= 100


def cartpole(store: Path, epoch: int = 1, **train: Any) -> Loop:
    store.mkdir(exist_ok=True)
    env = training(store, epoch=epoch, task="Cartpole", worlds=16, iterations=2, **train)
    job = Job.from_env(env, "train")
    raise_epoch(job.run, epoch)
    return Loop(Training.of(job, Cartpole), alone(), StopRequest())


def test_a_policy_is_evaluated_on_physics_that_training_did_not_see(tmp_path: Path) -> None:
    settings = {"config": {"randomize": {"mass": [0.5, 2.0], "observation_noise": 0.01}}}
    trained = cartpole(tmp_path / "a", **settings)
    assert trained.train() == 0
    before = trained.task.state_dict()
    others = held_out_worlds(trained)
    assert others.world_count == 16
    drawn = [task.state_tensors()["randomization_draws"][:, 0].clone() for task in (others, trained.task)]
    assert not (drawn[0][:, None] == drawn[1]).any()
    found = evaluate(others, trained.algorithm.policy(), trained.gang, checkpoint="x")
    assert all(torch.equal(tensor, before[name]) for name, tensor in trained.task.state_dict().items())
    again = cartpole(tmp_path / "a", epoch=2, **settings)
    assert again.resumed is not None
    worlds = held_out_worlds(again)
    assert torch.equal(worlds.state_tensors()["randomization_draws"][:, 0], drawn[0])
    assert evaluate(worlds, again.algorithm.policy(), again.gang, checkpoint="x").mean_return == found.mean_return


def test_where_worlds_are_alike_those_of_training_are_evaluated_from_new_starts(tmp_path: Path) -> None:
    trained = cartpole(tmp_path, config={"randomize": {"observation_noise": 0.01}})
    assert held_out_worlds(trained) is trained.task
