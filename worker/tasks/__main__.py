"""``python -m worker.tasks [NAME …]`` lists tasks as JSON. ``muster tasks`` runs it, since it imports no torch itself."""

from __future__ import annotations

import gc
import json
import sys
from typing import TYPE_CHECKING, Any

from shared_store.contract.error_text import counted
from worker.tasks import find_task, task_names
from worker.tasks.compile.images import shown
from worker.tasks.compile.tables import numbers, tables
from worker.tasks.run.mistakes import task_mistakes
from worker.tasks.run.policy_contract import robots_of

if TYPE_CHECKING:
    from worker.tasks.compile.plan import KernelPlan
    from worker.tasks.run.task import Task


def describe(name: str, whole: bool = False) -> dict[str, Any]:
    """A task's observations, actions and rewards.

    Args:
        name: As :func:`worker.tasks.find_task` takes it.
        whole: Include the tables of its terms and settings, the numbers that a job can change, and how
            its configuration changes them during training.

    Raises:
        ValueError: The task does not exist, or its own code is wrong.
    """
    kind = find_task(name)
    with task_mistakes(name):
        config = kind.config_type()
        task = kind.sketch(config)
    return {
        "name": name,
        "class": f"{kind.__module__}:{kind.__qualname__}",
        "about": (kind.__doc__ or "").strip().partition("\n")[0],
        "observations": _observations(task),
        "actions": list(task.action_names),
        "rewards": task.plan.weights,
        "control_hz": config.control_hz,
        "substeps": config.substeps,
        "episode_seconds": config.episode_seconds,
        **({**_whole(task.plan), "robots": _robots(task)} if whole else {}),
    }


def _robots(task: Task) -> list[str]:
    """A line for each robot as its file loads today, by which changes are seen, and the task's notes."""
    lines = []
    for each in robots_of(task):
        actuators = sum(actuator >= 0 for actuator in task.views[each.name].actuators)
        lines.append(
            f"{each.name}: {each.mass:g} kg, {counted(each.joints, 'joint')}, {counted(actuators, 'actuated joint')}"
        )
    return lines + list(task.notes())


def _whole(plan: KernelPlan) -> dict[str, Any]:
    curriculum = {name: [[*point] for point in points] for name, points in plan.config.curriculum.items()}
    return {"tables": tables(plan), "numbers": numbers(plan), "curriculum": curriculum}


def _observations(task: Task) -> list[str]:
    """Name of each observation; for each camera, one line that describes its image."""
    images = {group: shown(task.plan, group) for group in task.plan.images}
    names = [] if "policy" in images else list(task.observation_names)
    return names + [f"{'image' if group == 'policy' else group}: {words}" for group, words in images.items()]


def main(names: list[str]) -> int:
    """Print the tasks ``names``, or all; returns the exit code: 2 if a name is unknown.

    Without names, a task that can't be imported (of a broken package) is listed with its ``error``.
    """
    found = []
    for name in names or task_names():
        try:
            found.append(describe(name, whole=bool(names)))
        except ValueError as error:
            if names:
                print(error, file=sys.stderr)
                return 2
            found.append({"name": name, "error": str(error)})
        except Exception as error:
            if names:
                raise
            found.append({"name": name, "error": f"{type(error).__name__}: {error}"})
    print(json.dumps(found))
    return 0


if __name__ == "__main__":
    gc.disable()  # Importing the simulation parses hundreds of kernels; garbage collection would make that 50 % slower.
    sys.exit(main(sys.argv[1:]))
