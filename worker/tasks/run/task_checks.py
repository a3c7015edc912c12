"""Checks of a task: its arguments, and whether its step can be replayed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from worker.tasks.run.task import Task


def check_arguments(kind: type[Task], config: Any, world_count: int, seed: int, first_world: int) -> None:
    """Raise ValueError of one sentence for an argument of a task that is not valid."""
    task = kind.__name__
    if not isinstance(config, kind.config_type):
        raise ValueError(
            f"task {task} takes a {kind.config_type.__name__}, not a {type(config).__name__}; "
            f"make one with {kind.config_type.__name__}(...)"
        )
    if world_count < 1:
        raise ValueError(f"task {task} was asked for {world_count} worlds; ask for at least 1")
    if first_world < 0:
        raise ValueError(f"task {task}: first_world is {first_world}; use an index >= 0")
    if seed < 0:
        raise ValueError(f"task {task}: seed is {seed}; use an integer >= 0")


def assert_replays(task: Task, steps: Sequence[Callable[[], None]]) -> bool:
    """Replay the captured step once and check that it writes rewards, since an empty graph would step without an error; returns True.

    Raises:
        RuntimeError: The replay left a reward as it was.
    """
    task.rewards.fill_(float("nan"))
    for launch in steps:
        launch()
    if task.rewards.isnan().any():
        raise RuntimeError(f"the captured step of task {type(task).__name__} does not replay on {task.device}")
    return True
