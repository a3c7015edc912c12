"""SAC as a whole: its settings, how it resumes, exports and steps in a gang."""

from __future__ import annotations

import copy
import dataclasses
import io
from typing import Any

import pytest
import torch

from tests.support.worker.loop import alone, groups, iterate, setting_of, transition_of
from tests.support.worker.onnx import onnx_of
from tests.support.worker.sac import SMALL, make, point, same
from worker.learning.algorithm import LearningSetting, Spaces, WorldShare
from worker.learning.distributed import Gang, RankPlacement
from worker.learning.sac.sac import SAC, SAVED
from worker.settings.sac import SACConfig

torch.set_num_threads(1)


@pytest.mark.parametrize(
    ("settings", "named"),
    [
        ({"steps": True}, "steps"),
        ({"gamma": float("nan")}, "gamma"),
        ({"tau": 0.0}, "tau"),
        ({"batch_size": 64.0}, "batch_size"),
        ({"actor_sizes": []}, "actor_sizes"),
        ({"updates": 3}, "updates: expected a multiple of policy_delay"),
        ({"n_step": 2000}, "replay_steps: expected at least steps"),
        ({"v_min": 20.0}, "v_min: expected less than v_max"),
    ],
)
def test_settings_that_cannot_be_are_refused_by_name(settings: dict[str, Any], named: str) -> None:
    with pytest.raises(ValueError, match=named):
        SACConfig(**settings)


NO_GROUP = "critic_group: there is no observation group 'critic'"


@pytest.mark.parametrize(
    ("spaces", "settings", "message"),
    [
        (Spaces({"policy": (3, 8, 8)}, 1), {}, "it can't learn from images.*use ppo"),
        (Spaces({"policy": (3,)}, 4, discrete=True), {}, "this task's are choices; use ppo"),
        (Spaces({"policy": (3,)}, 1), {"critic_group": "critic"}, NO_GROUP),
    ],
)
def test_an_unsupported_setting_is_refused(spaces: Spaces, settings: dict[str, Any], message: str) -> None:
    setting = LearningSetting(spaces, WorldShare(0, 2, 2), alone(), 0)
    with pytest.raises(ValueError, match=f"^sac.*{message}"):
        SAC(dataclasses.replace(SMALL, **settings), setting)


@pytest.mark.parametrize("before", [1, 5, 9])
def test_a_resumed_run_ends_with_the_same_bits(before: int) -> None:
    """Saved while the ring fills, and after it has gone round."""
    task = point()
    whole = make(task, n_step=2, replay_steps=22)
    iterate(whole, task, 0, before)
    saved = copy.deepcopy((whole.state_dict(), whole.world_state(), task.state_dict()))
    metrics = iterate(whole, task, before, before + 4)

    other_task = point()
    torch.manual_seed(99)
    resumed = SAC(whole.config, setting_of(other_task, seed=1))
    buffer = io.BytesIO()
    torch.save(saved, buffer)
    buffer.seek(0)
    learner, worlds, states = torch.load(buffer, weights_only=True)
    resumed.load_state_dict(learner)
    resumed.load_world_state(worlds)
    other_task.load_state_dict(states)
    again = iterate(resumed, other_task, before, before + 4)
    assert same(dict(metrics), dict(again))
    assert same(whole.state_dict(), resumed.state_dict())
    assert same(dict(whole.world_state()), dict(resumed.world_state()))
    assert all(tensor.shape[0] == 6 for tensor in whole.world_state().values())


def test_without_its_replay_a_resumed_run_fills_a_new_one_with_the_policy() -> None:
    task = point(400)
    sac = make(task, save_replay=False, warm_up=8, init_std=0.1, replay_steps=16)
    iterate(sac, task, 0, 3)
    assert sac.world_state() == {}
    resumed = make(task, save_replay=False, warm_up=8, init_std=0.1, replay_steps=16)
    resumed.load_state_dict(sac.state_dict())
    resumed.load_world_state(sac.world_state())
    resumed.begin(3)
    assert resumed.act(groups(task)).std() < 0.3, "it has learnt: no uniform actions"
    learnt = copy.deepcopy(resumed.learner.critics.state_dict())
    iterate(resumed, task, 3, 4)
    assert same(learnt, resumed.learner.critics.state_dict()), "4 steps are too few"
    iterate(resumed, task, 4, 5)
    assert not same(learnt, resumed.learner.critics.state_dict())


def test_a_small_replay_is_saved_and_a_large_one_is_not(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """On a GPU a save of gigabytes would take as long as hundreds of iterations."""
    task = point()
    size = 32 * 6 * (2 * 2 + 1 + 3) * 4
    monkeypatch.setitem(SAVED, "cpu", size)
    assert make(task).world_state() and not capsys.readouterr().out
    monkeypatch.setitem(SAVED, "cpu", size - 1)
    assert make(task).world_state() == {}
    reported = "checkpoints do not hold the replay, 0 MiB a rank: a run that is resumed fills a new one first "
    assert capsys.readouterr().out.startswith(reported)
    assert make(task, save_replay=True).world_state() and not make(task, save_replay=False).world_state()
    make(point(2), gang=Half(1), share=WorldShare(3, 2, 5))
    SAC(SMALL, dataclasses.replace(setting_of(task), rehearsal=True))
    assert not capsys.readouterr().out, "the main rank tells it, and only of a run that is to begin"


@pytest.mark.parametrize(("total", "saved"), [(5, True), (7, False)])
def test_all_ranks_save_their_replay_or_none(monkeypatch: pytest.MonkeyPatch, total: int, saved: bool) -> None:
    """The rank with the most worlds decides."""
    monkeypatch.setitem(SAVED, "cpu", 32 * (2 * 2 + 1 + 3) * 4 * 3)
    shares = [WorldShare.of(rank, 2, total) for rank in range(2)]
    assert shares[0].count < shares[1].count and shares[0].count <= 3
    made = [make(point(share.count), gang=Half(rank), share=share) for rank, share in enumerate(shares)]
    assert [bool(sac.world_state()) for sac in made] == [saved, saved]


def test_only_weights_are_loaded_with_new_optimizers() -> None:
    task = point()
    sac = make(task)
    iterate(sac, task, 0, 4)
    fresh = make(task, critic_learning_rate=0.123)
    fresh.load_state_dict(sac.state_dict(), weights_only=True)
    mine, theirs = fresh.state_dict(), sac.state_dict()
    for part in ("policy", "critics", "targets", "updates"):
        assert same(mine[part], theirs[part])
    assert float(fresh.learner.temperature) == pytest.approx(fresh.config.init_temperature), "it is worth in rewards"
    assert float(sac.learner.temperature) != pytest.approx(fresh.config.init_temperature)
    assert not mine["critic_optimizer"]["state"] and theirs["critic_optimizer"]["state"]
    full = make(task, critic_learning_rate=0.123)
    full.load_state_dict(sac.state_dict())
    group = full.learner._critic_optimizer.param_groups[0]
    assert group["lr"] == 0.123, "the job's learning rate, not the checkpoint's"
    with pytest.raises(RuntimeError):
        make(task, critic_sizes=(8,)).load_state_dict(sac.state_dict())
    iterate(sac, task, 4, 9)
    with pytest.raises(ValueError, match=r"replay_steps"):
        make(task, replay_steps=40).load_world_state(sac.world_state())


def test_the_exported_policy_computes_the_same() -> None:
    task = point()
    sac = make(task, action_limit=0.8)
    iterate(sac, task, 0, 5)
    exported = sac.policy().module()
    assert list(exported.inputs) == ["obs"] and list(exported.outputs) == ["actions"]
    (found,) = onnx_of(exported).run(None, {"obs": exported.sample["policy"].numpy()})
    torch.testing.assert_close(torch.from_numpy(found), sac.policy().act(exported.sample), atol=1e-5, rtol=0)
    moved = exported.sample["policy"].mean(0) - sac.learner.actor.normalizer.mean
    assert (moved.abs() < 0.5).all(), "the sample is of what the policy has met"


class Half(Gang):
    """One of two ranks in this process: what it would share is kept until both are there."""

    def __init__(self, rank: int) -> None:
        super().__init__(RankPlacement(rank=rank, world_size=2), "cpu", None, ["here", "there"])

    def sum(self, tensor: torch.Tensor) -> torch.Tensor:
        return tensor

    def broadcast(self, tensor: torch.Tensor) -> torch.Tensor:
        return tensor


def test_two_ranks_take_the_step_that_one_takes_with_the_same_samples() -> None:
    """Moments of observations, gradients and losses of two ranks add up to those of one that has their worlds and their samples."""
    one_task, tasks = point(6), [point(2), point(4, first=2)]
    settings = {"batch_size": 25, "n_step": 2}
    one = make(one_task, **settings)
    ranks = [
        make(task, gang=Half(rank), share=share, **settings)
        for rank, (task, share) in enumerate(zip(tasks, (WorldShare(0, 2, 6), WorldShare(2, 4, 6)), strict=True))
    ]
    assert [sac.learner.samples for sac in ranks] == [12, 13]
    for sac, task in ((one, one_task), *zip(ranks, tasks, strict=True)):
        sac.begin(0)
        for _ in range(sac.steps):
            task.step(sac.act(groups(task)))
            sac.record(transition_of(task))
        sac.replay.advance(sac.steps)
        sac._gather_moments()
    assert torch.equal(one.replay.after, torch.cat([sac.replay.after for sac in ranks], 1)), "the same worlds"
    torch.testing.assert_close(one._moment_sums, ranks[0]._moment_sums + ranks[1]._moment_sums)
    for sac in (one, *ranks):
        sac._moment_sums.copy_(one._moment_sums)
        sac._merge_moments()

    noise = torch.randn(2, 25, 1)
    rows = [sac._all_rows[0] for sac in ranks]
    of_one = [rows // count * 6 + rows % count + first for rows, count, first in zip(rows, (2, 4), (0, 2), strict=True)]
    one.learner.compute(one.replay.sample(torch.cat(of_one)), noise, True)
    for sac, part, its in zip(ranks, (noise[:, :12], noise[:, 12:]), rows, strict=True):
        sac.learner.compute(sac.replay.sample(its), part, True)
    together = ranks[0].learner.shared(True) + ranks[1].learner.shared(True)
    torch.testing.assert_close(one.learner.shared(True), together, atol=1e-6, rtol=1e-4)
    with pytest.raises(ValueError, match=r"sac.batch_size: 2 ranks need at least as many samples, got 1"):
        make(tasks[0], gang=Half(0), share=WorldShare(0, 2, 6), batch_size=1)
