"""A task's state set by hand, judged, and played at random."""

from __future__ import annotations

from typing import Any

import torch

from worker.simulation.episodes import STEP
from worker.tasks.run.task import Task


def put(task: Task, **rows: list[Any]) -> None:
    """Overwrite parts of a task's state; what is not named is as after a reset from seed 1."""
    task.seed(1)
    task.reset()
    task.clear_statistics()
    state = task.state_dict()
    for name, values in rows.items():
        state[name][: len(values)] = torch.tensor(values, dtype=state[name].dtype)
    task.load_state_dict(state)


def observe(task: Task) -> None:
    """Judge the state as it stands, as after a physics step."""
    task._control.judge_and_observe(int(STEP))


def statistics(task: Task) -> dict[str, float]:
    return dict(zip(task.statistic_names, task.statistics.tolist(), strict=True))


def play(task: Task, steps: int, seed: int) -> list[tuple[torch.Tensor, ...]]:
    """Act at random, the same in every world of the same global index; clones of all that a step gives."""
    generator = torch.Generator().manual_seed(seed)
    history: list[tuple[torch.Tensor, ...]] = []
    for _ in range(steps):
        actions = torch.randn(64, task.action_size, generator=generator)[task.first_world :][: task.world_count]
        task.step(actions)
        history.append((task.observations.clone(), task.rewards.clone(), task.dones.clone(), task.time_outs.clone()))
    return history


def played_twice(task: Task) -> tuple[list[tuple[torch.Tensor, ...]], list[tuple[torch.Tensor, ...]]]:
    """What twenty steps give from a state in the middle, and what they give once that state is loaded again."""
    play(task, 7, seed=1)
    saved = task.state_dict()
    first = play(task, 20, seed=2)
    task.load_state_dict(saved)
    return first, play(task, 20, seed=2)


def plays_like_its_part(whole: Task, part: Task) -> bool:
    """Whether the worlds from ``part.first_world`` on do the same in both tasks."""
    put(whole)
    put(part)
    first = part.first_world
    pairs = zip(play(whole, 8, seed=3), play(part, 8, seed=3), strict=True)
    return all(torch.equal(a[first:], b) for steps in pairs for a, b in zip(*steps, strict=True))


def same(left: list[tuple[torch.Tensor, ...]], right: list[tuple[torch.Tensor, ...]]) -> bool:
    return all(torch.equal(a, b) for x, y in zip(left, right, strict=True) for a, b in zip(x, y, strict=True))
