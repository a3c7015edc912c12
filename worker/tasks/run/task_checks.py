"""Checks of a task: its arguments, its interface, and whether its step can be replayed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from worker.tasks.declare.interface import Interface, Observation, deviations

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
    if not kind.reward_terms:
        raise ValueError(
            f"task {task} has no reward terms; give {kind.config_type.__name__} a field "
            "`rewards: Mapping[str, float] = reward_weights(name=weight, ...)`"
        )
    for name in config.curriculum:
        if "." in name and not hasattr(kind, "declare"):
            raise ValueError(f"task {task}: curriculum: it has no number {name}; declared tasks have such")
    if world_count < 1:
        raise ValueError(f"task {task} was asked for {world_count} worlds; ask for at least 1")
    if first_world < 0:
        raise ValueError(f"task {task}: first_world is {first_world}; use an index >= 0")
    if seed < 0:
        raise ValueError(f"task {task}: seed is {seed}; use an integer >= 0")


def checked_interface(task: Task) -> Interface:
    """The task's interface, or the names of its observations alone.

    Raises:
        ValueError: Its names or their order differ from the task's.
    """
    interface = task.interface() or Interface(tuple(map(Observation, task.observation_names)), ())
    for what, declared, names in (
        ("observations", interface.observations, task.observation_names),
        ("actions", interface.actions, task.action_names),
    ):
        if declared and tuple(item.name for item in declared) != tuple(names):
            raise ValueError(
                f"task {type(task).__name__}: interface() has other {what} than the task, or in another order; "
                f"they are {', '.join(names)}"
            )
    return interface


def noise_of(task: Task) -> list[float]:
    """Standard deviation of the noise on each observation. Raises ValueError for an interface or a noise that does not fit."""
    interface = checked_interface(task)
    try:
        return deviations(task.config.randomize.observation_noise, interface.observations)
    except ValueError as error:
        raise ValueError(f"config.randomize.observation_noise: {error}") from error


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
