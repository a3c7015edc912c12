"""Whole episodes with the policy's best action, from fresh resets, in the worlds of all ranks: one row for each."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch

from worker.learning.algorithm import Acting, Policy
from worker.learning.distributed import Gang
from worker.learning.setup import observed

if TYPE_CHECKING:
    from tensordict import TensorDict

    from worker.tasks.run.task import Task

SIZE = 32
"""Worlds of a block."""
_RETURN, _LENGTH, _TIME_OUT, _CAUSE, _SUCCESS, _TERMS = range(6)
_CHECKED = 32
"""Steps between two checks whether any episode still runs: a check waits for the device and for the other ranks."""


class Stopped(Exception):
    """The gang was requested to leave; nothing was recorded."""


class Blocks:
    """One policy for each block of worlds, together acting for all of them: it acts on a fixed number of worlds at a time.

    The products of a network round otherwise for another number of rows. In blocks of one size, in which an episode always has the same
    row, an action is a function of the observation and the row alone.

    Args:
        policies: Of each block, alike; they may remember their episodes. There are ``size`` worlds for each.
        size: Worlds of a block.
    """

    def __init__(self, policies: Sequence[Policy], size: int = SIZE) -> None:
        self._policies, self._size = policies, size

    def act(self, observations: TensorDict) -> torch.Tensor:
        """Best actions, shape ``(worlds, actions)``."""
        parts: Any = observations.split(self._size)
        return torch.cat([policy.act(part) for policy, part in zip(self._policies, parts, strict=True)])

    def reset(self, worlds: torch.Tensor | None = None) -> None:
        """Forget the running episodes of all worlds, or where ``worlds`` is true."""
        parts = [None] * len(self._policies) if worlds is None else worlds.split(self._size)
        for policy, part in zip(self._policies, parts, strict=True):
            policy.reset(part)


@dataclass(frozen=True)
class Episodes:
    """The record of each episode, by its number; the same on all ranks.

    Attributes:
        rows: Shape ``(episodes, 5 + terms)``, float64, on the CPU: return, length [steps], whether the clock ended it, index of its cause
            in ``causes``, whether it was a success, and the terms.
        terms: Names of the terms: ``reward_NAME`` is the weighted sum over the episode, ``metric_NAME`` the mean over its steps, or the last value.
        causes: What can end an episode, by name.
        success: What a success is, in words; None where the task does not say.
    """

    rows: torch.Tensor
    terms: Sequence[str]
    causes: Sequence[str]
    success: str | None

    @property
    def returns(self) -> torch.Tensor:
        """Sum of the rewards of each episode."""
        return self.rows[:, _RETURN]

    @property
    def lengths(self) -> torch.Tensor:
        """Steps of each episode."""
        return self.rows[:, _LENGTH]

    @property
    def time_outs(self) -> torch.Tensor:
        """Whether the clock ended it, or a termination that counts as the clock; bool."""
        return self.rows[:, _TIME_OUT] > 0

    @property
    def ends(self) -> list[str]:
        """By what each episode ended."""
        return [self.causes[int(cause)] for cause in self.rows[:, _CAUSE].tolist()]

    @property
    def successes(self) -> torch.Tensor | None:
        """Whether each was a success, bool; None where the task does not say what that is."""
        return None if self.success is None else self.rows[:, _SUCCESS] > 0

    def term(self, name: str) -> torch.Tensor:
        """The column of a term."""
        return self.rows[:, _TERMS + list(self.terms).index(name)]


def play(
    rounds: Iterable[Task],
    policy: Acting,
    gang: Gang,
    *,
    episodes: int | None = None,
    is_stop_requested: Callable[[], bool] = lambda: False,
    watch: Callable[[torch.Tensor], None] | None = None,
    count: Callable[[int, int], None] = lambda done, total: None,
) -> Episodes:
    """One episode of every world in each round; all ranks call it.

    Every world of a round contributes one whole episode, so that short ones are not counted more often than long ones. Episodes are
    numbered round by round, and in a round by the global index of the world.

    Args:
        rounds: The worlds of this rank, prepared for one round after the other.
        policy: Takes the best actions.
        gang: The ranks.
        episodes: How many are kept, the first ones; all by default.
        is_stop_requested: Whether this rank was requested to leave; checked now and then.
        watch: Called after each control step with the worlds whose episode had not ended before it, shape ``(worlds,)``, bool.
        count: Called now and then with the control steps of the round that are done, and how many it has at most.

    Raises:
        Stopped: A rank was requested to leave.
    """
    parts, task = [], None
    for task in rounds:
        parts.append(_gather(_one_round(task, policy, gang, is_stop_requested, watch, count), gang))
    assert task is not None
    ended = task.ended
    success = ended.meaning if ended and ended.says_success else None
    if ended is None:
        return Episodes(torch.cat(parts)[:episodes], (), ("time_out", "physics_failed", "terminated"), success)
    return Episodes(torch.cat(parts)[:episodes], ended.columns, ended.names, success)


def _one_round(
    task: Task,
    policy: Acting,
    gang: Gang,
    is_stop_requested: Callable[[], bool],
    watch: Callable[[torch.Tensor], None] | None,
    count: Callable[[int, int], None],
) -> torch.Tensor:
    """Rows of the first episode of each world after a reset, shape ``(worlds, columns)``."""
    task.reset()
    policy.reset()
    observations = observed(task)
    terms = len(task.ended.columns) if task.ended else 0
    rows = torch.zeros(task.world_count, _TERMS + terms, device=task.device)
    running = torch.ones(task.world_count, dtype=torch.bool, device=task.device)
    for step in range(task.max_episode_length):
        task.step(policy.act(observations))
        policy.reset(task.dones)
        if watch is not None:
            watch(running)
        rows[:, _RETURN] += torch.where(running, task.rewards, 0.0)
        rows[:, _LENGTH] += running
        ended = running & (task.dones != 0)
        rows[:, _TIME_OUT:] = torch.where(ended[:, None], _end(task), rows[:, _TIME_OUT:])
        running &= ~ended
        # all ranks decide alike; where all episodes are short it saves most of the time
        if step % _CHECKED == _CHECKED - 1:
            count(step + 1, task.max_episode_length)
            state = gang.greatest(2 if is_stop_requested() else int(running.any()))
            if state == 2:
                raise Stopped
            if state == 0:
                break
    return rows


def _end(task: Task) -> torch.Tensor:
    """Cause of end and terms of the episodes that ended in this step, shape ``(worlds, 3 + terms)``; old numbers for the other worlds."""
    time_outs = task.time_outs != 0
    if (ended := task.ended) is None:
        cause = torch.where(time_outs, 0.0, 2.0)
        return torch.stack([time_outs.float(), cause, time_outs.float()], 1)
    facts = torch.stack([time_outs.float(), ended.causes.float(), ended.successes(time_outs).float()], 1)
    return torch.cat([facts, ended.terms], 1)


def _gather(rows: torch.Tensor, gang: Gang) -> torch.Tensor:
    """The rows of all ranks, in the order of the ranks, float64, on the CPU."""
    counts = torch.zeros(gang.size, dtype=torch.int64, device=gang.device)
    counts[gang.rank] = len(rows)
    known = gang.sum(counts).tolist()
    first = sum(known[: gang.rank])
    # a sum with zeros is exact, and every backend has it
    whole = torch.zeros(sum(known), rows.shape[1], dtype=torch.float64, device=gang.device)
    whole[first : first + len(rows)] = rows
    return gang.sum(whole).cpu()
