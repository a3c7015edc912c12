"""Whole episodes with the policy's mean action, from fresh resets, in the worlds of all ranks: one row for each."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import torch

from worker.learning.distributed import Gang
from worker.learning.setup import observed

if TYPE_CHECKING:
    from worker.tasks.run.task import Task

_RETURN, _LENGTH, _TIME_OUT, _CAUSE, _SUCCESS, _TERMS = range(6)
LOOK = 32
"""Steps between two looks at whether any episode still runs: looking waits for the device and for the other ranks."""


class Acting(Protocol):
    """A policy, as far as it is evaluated: see :class:`worker.learning.algorithm.Policy`."""

    def act(self, observations: Any) -> torch.Tensor:
        """Mean actions, shape ``(worlds, actions)``, for the task's observation groups."""

    def reset(self, worlds: torch.Tensor | None = None) -> None:
        """Forget what is remembered of the running episodes, of all worlds or where ``worlds`` is true."""


class Stopped(Exception):
    """The gang was asked to leave; nothing was recorded."""


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
    is_asked_to_stop: Callable[[], bool] = lambda: False,
    look: Callable[[torch.Tensor], None] | None = None,
) -> Episodes:
    """One episode of every world in each round; all ranks call it.

    Every world of a round contributes one whole episode, so that short ones are not counted more often than long ones. Episodes are
    numbered round by round, and in a round by the global index of the world.

    Args:
        rounds: The worlds of this rank, prepared for one round after the other.
        policy: Takes the mean actions.
        gang: The ranks.
        episodes: How many are kept, the first ones; all by default.
        is_asked_to_stop: Whether this rank was asked to leave; looked at now and then.
        look: Called after each control step with the worlds whose episode had not ended before it, shape ``(worlds,)``, bool.

    Raises:
        Stopped: A rank was asked to leave.
    """
    parts, task = [], None
    for task in rounds:
        parts.append(_gather(_one_round(task, policy, gang, is_asked_to_stop, look), gang))
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
    is_asked_to_stop: Callable[[], bool],
    look: Callable[[torch.Tensor], None] | None,
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
        if look is not None:
            look(running)
        rows[:, _RETURN] += torch.where(running, task.rewards, 0.0)
        rows[:, _LENGTH] += running
        over = running & (task.dones != 0)
        rows[:, _TIME_OUT:] = torch.where(over[:, None], _end(task), rows[:, _TIME_OUT:])
        running &= ~over
        # all ranks decide alike; where all episodes are short it saves most of the time
        if step % LOOK == LOOK - 1:
            state = gang.greatest(2 if is_asked_to_stop() else int(running.any()))
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
