"""The built-in tasks and how a task is found by name."""

from __future__ import annotations

import importlib
import os
import sys
from importlib.metadata import entry_points
from typing import TYPE_CHECKING

from shared_store.wording import nearest

if TYPE_CHECKING:
    from worker.tasks.task import Task

BUILT_IN = {
    "Cartpole": "worker.tasks.cartpole:Cartpole",
    "CartpolePixels": "worker.tasks.cartpole_pixels:CartpolePixels",
    "Ant": "worker.tasks.ant:Ant",
    "Humanoid": "worker.tasks.humanoid:Humanoid",
    "Quadruped": "worker.tasks.quadruped:Quadruped",
}
"""Tasks that are there even where the distribution's metadata is not (a source tree on the path)."""


def task_names() -> dict[str, str]:
    """Every known task: its name and where its class is (``module:Class``), sorted by name."""
    found = {point.name: point.value for point in entry_points(group="muster.tasks")}
    return dict(sorted((BUILT_IN | found).items()))


def find_task(name: str) -> type[Task]:
    """The class of a task.

    Args:
        name: A built-in task, one that an installed package offers under the entry point group ``muster.tasks``, or
            ``module:Class``.

    Raises:
        ValueError: There is no such task, or what is there is not a task.
    """
    known = task_names()
    where = name if ":" in name else known.get(name)
    if where is None:
        raise ValueError(f"no task is called {name!r}; {nearest(name, known)} (your own: module:Class)")
    module_name, _, class_name = where.partition(":")
    if name == where and os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())  # a user's module lies where the job was submitted; ours are never hidden by it
    try:
        module = importlib.import_module(module_name)
    except ModuleNotFoundError as error:
        if error.name is None or not (module_name == error.name or module_name.startswith(error.name + ".")):
            raise
        raise ValueError(f"task {name!r}: there is no module {module_name!r} on the path") from error
    found = getattr(module, class_name, None)
    from worker.tasks.task import Task

    if not (isinstance(found, type) and issubclass(found, Task)):
        raise ValueError(f"task {name!r}: {module_name} has no class {class_name!r} that is a worker.tasks.task.Task")
    return found
