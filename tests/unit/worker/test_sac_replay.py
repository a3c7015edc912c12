"""How SAC explores, and what its replay gives back, against loops."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from tensordict import TensorDict

from tests.support.worker.loop import alone, groups, iterate, transition_of
from tests.support.worker.sac import SMALL, make, point
from worker.learning.algorithm import LearningSetting, Spaces, Transition, WorldShare
from worker.learning.sac.replay_buffer import ReplayBuffer
from worker.learning.sac.sac import SAC

torch.set_num_threads(1)


def test_actions_of_an_iteration_do_not_depend_on_the_ranks() -> None:
    def actions(first: int, count: int) -> torch.Tensor:
        task, drawn = point(count, first), []
        sac = make(task, share=WorldShare(first, count, 6), warm_up=0)
        for iteration in range(2):
            sac.begin(iteration)
            for _ in range(sac.steps):
                drawn.append(sac.act(groups(task)).clone())
                sac.record(transition_of(task))
        return torch.stack(drawn)

    whole = actions(0, 6)
    torch.testing.assert_close(whole, torch.cat((actions(0, 2), actions(2, 4)), 1))
    assert len(torch.unique(whole)) == whole.numel(), "every step has its own noise"


def test_actions_are_random_until_the_first_update() -> None:
    task = point(400)
    sac = make(task, warm_up=6, init_std=0.1)
    drawn: list[torch.Tensor] = []
    for iteration in range(3):
        sac.begin(iteration)
        drawn.append(sac.act(groups(task)).clone())
        iterate(sac, task, iteration, iteration + 1)
    spread = [float(each.std()) for each in drawn]
    assert spread[0] > 0.5 and spread[1] > 0.5 and spread[2] < 0.2
    assert sac.state_dict()["updates"] == 8, "4 steps are too few for the first iteration, 8 are enough"


def fill(
    replay: ReplayBuffer, steps: int, ends: torch.Tensor | None = None, time_outs: torch.Tensor | None = None
) -> None:
    """Write ``steps`` steps whose observations, actions and rewards say which step, counted from 0, and which world they are of."""
    slot = torch.zeros(1, dtype=torch.int64)
    for step in range(steps):
        replay.find_slots(slot)
        number = torch.arange(replay.worlds).float() + 100.0 * step
        ended = ends[step] if ends is not None else torch.zeros(replay.worlds, dtype=torch.bool)
        after = ~ended | (time_outs[step] if time_outs is not None else False)
        outcomes = torch.stack((number, (~ended).float(), after.float()), 1)
        replay.write(slot, torch.stack((number, -number), 1), number.unsqueeze(1) + 0.5, outcomes)
        replay.advance(1)


@pytest.mark.parametrize("n_step", [1, 3])
def test_only_what_is_there_is_drawn_and_all_of_it(n_step: int) -> None:
    worlds, capacity = 3, 7
    generator = torch.Generator().manual_seed(0)
    for recorded in range(1, 24):
        replay = ReplayBuffer(capacity, worlds, 1, 1, n_step, 0.9, "cpu")
        fill(replay, recorded)
        rows = torch.zeros(4000, dtype=torch.int64)
        existing = replay.draw(rows, generator)
        assert existing == (recorded >= n_step)
        if existing:
            started = (replay.sample(rows).before[:, 0] / 100.0).floor()
            expected = torch.arange(max(0, recorded - capacity), recorded - n_step + 1)
            assert torch.equal(started.unique(), expected.float())
            found = replay.sample(rows).before[:, 0].unique()
            assert len(found) == len(expected) * worlds


def by_loop(world: int, first: int, n: int, gamma: float, ends: torch.Tensor, time_outs: torch.Tensor) -> list[float]:
    """Return, discount and last step of the transition that begins in step ``first``."""
    total, worth = 0.0, 1.0
    for step in range(first, first + n):
        total += worth * (100.0 * step + world)
        worth *= gamma
        if ends[step, world]:
            return [total, worth if time_outs[step, world] else 0.0, step]
    return [total, worth, first + n - 1]


@pytest.mark.parametrize("n_step", [1, 2, 5])
def test_returns_of_n_steps_against_a_loop(n_step: int) -> None:
    steps, worlds, capacity, gamma = 50, 4, 30, 0.9
    generator = torch.Generator().manual_seed(1)
    ends = torch.rand(steps, worlds, generator=generator) < 0.3
    time_outs = ends & (torch.rand(steps, worlds, generator=generator) < 0.5)
    replay = ReplayBuffer(capacity, worlds, 1, 1, n_step, gamma, "cpu")
    fill(replay, steps, ends, time_outs)
    rows = torch.zeros(2000, dtype=torch.int64)
    assert replay.draw(rows, generator)
    batch = replay.sample(rows)
    for i in range(len(rows)):
        first, world = divmod(int(batch.before[i, 0]), 100)
        total, worth, last = by_loop(world, first, n_step, gamma, ends, time_outs)
        assert batch.returns[i].item() == pytest.approx(total, rel=1e-5)
        assert batch.discounts[i].item() == pytest.approx(worth)
        assert batch.after[i].item() == 100.0 * last + world + 0.5
        assert batch.before[i, 1] == -batch.before[i, 0]


def transition(observation: float, terminal: float, reward: float, done: bool, time_out: bool) -> Transition:
    """Of one world with one observation."""
    seen, ended = (TensorDict({"policy": torch.tensor([[x]])}, batch_size=[1]) for x in (observation, terminal))
    return Transition(seen, ended, torch.tensor([reward]), torch.tensor([done]), torch.tensor([time_out]))


def test_a_time_out_bootstraps_from_the_observation_before_the_reset_and_a_termination_does_not() -> None:
    setting = LearningSetting(Spaces({"policy": (1,)}, 1), WorldShare(0, 1, 1), alone(), 0)
    sac = SAC(dataclasses.replace(SMALL, atoms=1, steps=3, warm_up=100, normalize_observations=False), setting)
    nan = float("nan")
    sac.begin(0)
    taken = []
    for observation, step in (
        (1.0, transition(2.0, nan, 10.0, False, False)),
        (2.0, transition(-1.0, 3.0, 20.0, True, True)),  # the clock ended it in 3, and a new episode begins in −1
        (-1.0, transition(-2.0, -3.0, 30.0, True, False)),  # it fell
    ):
        taken.append(sac.act(TensorDict({"policy": torch.tensor([[observation]])}, batch_size=[1])).clone())
        sac.record(step)
    batch = sac.replay.sample(torch.arange(3))
    assert batch.before[:, 0].tolist() == [1.0, 2.0, -1.0]
    assert torch.equal(batch.before[:, 1:], torch.cat(taken))
    assert batch.after.flatten().tolist() == [2.0, 3.0, -3.0]
    # target critics that say 100 times what they see, and 7 for the entropy; γ = 0.9
    target = sac.learner.target(100.0 * batch.after.expand(2, -1, -1), batch, torch.full((3,), 7.0))
    assert target.flatten().tolist() == pytest.approx([10 + 0.9 * 207, 20 + 0.9 * 307, 30.0])
