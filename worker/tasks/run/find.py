"""Find a task by its name: Muster's own, those of installed packages, and those of users."""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Iterable
from importlib.metadata import EntryPoint, entry_points
from typing import TYPE_CHECKING

from shared_store.contract.entry_points import clash
from shared_store.contract.error_text import nearest, unknown_task
from worker.tasks.run.mistakes import task_mistakes

if TYPE_CHECKING:
    from worker.tasks.run.task import Task

_GROUP = "muster.tasks"
BUILT_IN = {
    "Cartpole": "worker.tasks.library.cartpole:Cartpole",
    "CartpolePixels": "worker.tasks.library.cartpole_pixels:CartpolePixels",
    "Ant": "worker.tasks.library.ant:Ant",
    "Humanoid": "worker.tasks.library.humanoid:Humanoid",
    "Quadruped": "worker.tasks.library.quadruped:Quadruped",
    "Go1Flat": "worker.tasks.library.go1:Go1Flat",
    "Go1Rough": "worker.tasks.library.go1:Go1Rough",
    "G1Flat": "worker.tasks.library.g1:G1Flat",
    "G1Rough": "worker.tasks.library.g1:G1Rough",
    "LiftCube": "worker.tasks.library.lift:LiftCube",
    "LiftCubes": "worker.tasks.library.lift_cubes:LiftCubes",
}
"""Tasks found even without the distribution's metadata (a source tree on the path)."""


def task_names() -> dict[str, str]:
    """Every known task: its name and its class (``module:Class``), sorted by name."""
    return _classes(entry_points(group=_GROUP))


def _classes(points: Iterable[EntryPoint]) -> dict[str, str]:
    return dict(sorted((BUILT_IN | {point.name: point.value for point in points}).items()))


def find_task(name: str) -> type[Task]:
    """The class of a task.

    Args:
        name: A built-in task, one that an installed package offers under the entry point group ``muster.tasks``, or
            ``module:Class``.

    Raises:
        ValueError: The task does not exist, two packages have one of this name, the class is not a task, or the user's module
            can't be imported.
    """
    points = entry_points(group=_GROUP)
    if words := clash(points, name, BUILT_IN.get(name, "")):
        raise ValueError(f"task {name!r}: {words}")
    known = _classes(points)
    where = name if ":" in name else known.get(name)
    if where is None:
        raise ValueError(unknown_task(name, known))
    module_name, _, class_name = where.partition(":")
    if name == where and os.getcwd() not in sys.path:
        sys.path.append(
            os.getcwd()
        )  # a user's module is in the submitter's directory; last, so that it hides none of ours
    try:
        importlib.import_module(
            "worker.simulation"
        )  # before newton, of which a task's module may be the first importer
        with task_mistakes(name):
            module = importlib.import_module(module_name)
    except SystemExit as error:  # else it would end who lists all tasks
        raise ValueError(f"task {name!r}: {module_name} exits when it is imported (code {error.code})") from error
    except ModuleNotFoundError as error:
        if error.name is None or not (module_name == error.name or module_name.startswith(error.name + ".")):
            raise
        raise ValueError(
            f"task {name!r}: there is no module {module_name!r} on the path, nor in {os.getcwd()}"
        ) from error
    found = getattr(module, class_name, None)
    from worker.tasks.run.task import Task

    if not (isinstance(found, type) and issubclass(found, Task)):
        classes = {key: each for key, each in vars(module).items() if isinstance(each, type) and issubclass(each, Task)}
        own = [key for key, each in classes.items() if each.__module__ == module_name]  # with_ names no class
        hint = nearest(class_name, own)
        raise ValueError(
            f"task {name!r}: {module_name} has no class {class_name!r} that is a worker.tasks.Task; {hint}"
        )
    if found.changes and module_name == found.__module__:  # by with_, which knows no name
        found.__name__ = found.__qualname__ = class_name
    return found
