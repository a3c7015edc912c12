"""The declared tasks compute what kernels written by hand for them compute, step by step from the same state.

The kernels' Humanoid is built at another height, so that what MuJoCo-Warp derives from the masses differs in the last digits.
"""

from __future__ import annotations

import importlib

import pytest
import torch

from worker.tasks import find_task

WORLDS = 6


@pytest.mark.parametrize(
    ("name", "close"), [("Cartpole", 1e-6), ("Ant", 2e-5), ("Humanoid", 2e-3), ("Quadruped", 2e-6)]
)
def test_a_declared_task_is_what_its_kernels_are(name: str, close: float) -> None:
    declared = find_task(name)
    by_hand = getattr(importlib.import_module(f"tests.support.worker.kernels.{name.lower()}"), name)
    # so that some episodes end, by the clock and otherwise
    config = declared.config_type(episode_seconds=0.8)
    task, other = declared(config, WORLDS, seed=3), by_hand(config, WORLDS, seed=3)
    assert task.observation_names == other.observation_names and task.action_names == other.action_names
    for mine, theirs in zip(task.interface().observations, other.interface().observations, strict=True):
        assert (mine.name, mine.unit, mine.kind, mine.range) == (theirs.name, theirs.unit, theirs.kind, theirs.range)
        assert (mine.scale, mine.offset) == pytest.approx((theirs.scale, theirs.offset), abs=1e-6)
    generator = torch.Generator().manual_seed(0)
    ended = 0
    for _ in range(60):
        follow(task, other)
        actions = 1.5 * torch.randn(WORLDS, task.action_size, generator=generator)
        task.step(actions)
        other.step(actions)
        assert torch.equal(task.dones, other.dones) and torch.equal(task.time_outs, other.time_outs)
        ended += int(other.dones.sum())
        torch.testing.assert_close(task.rewards, other.rewards, atol=close, rtol=1e-5)
        sums = task._sums[:, : other._sums.shape[1]]  # behind them the metrics, which the kernels do not have
        torch.testing.assert_close(sums, other._sums, atol=close, rtol=1e-4)
        stays, ends = ~other.dones, other.dones
        torch.testing.assert_close(task.observations[stays], other.observations[stays], atol=close, rtol=1e-5)
        torch.testing.assert_close(
            task.terminal_observations[ends], other.terminal_observations[ends], atol=close, rtol=1e-5
        )
        if name != "Quadruped":  # whose commands are drawn otherwise
            torch.testing.assert_close(task.observations, other.observations, atol=close, rtol=1e-5)
    assert ended >= WORLDS


def follow(task: object, other: object) -> None:
    """Bring the declared task into the state of the other."""
    state, theirs = task.state_dict(), other.state_dict()
    state |= {name: tensor for name, tensor in theirs.items() if name in state and name != "memory"}
    if "memory" in theirs:  # the Quadruped's: command, countdown, last action
        state["memory"][:, :4] = theirs["memory"][:, :4]
        state["last_actions"] = theirs["memory"][:, 4:16]
    task.load_state_dict(state)
