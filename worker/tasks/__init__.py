"""Tasks: find one by name, and the public parts of a task of your own.

The names here are public: ``from worker.tasks import DeclaredTask, Declaration, Robot, terms``. Each is imported on first use,
because most of them import the simulation.
"""

from __future__ import annotations

import importlib
import os
import sys
from importlib.metadata import entry_points
from typing import TYPE_CHECKING, Any

from shared_store.contract.error_text import nearest
from worker.tasks.run.mistakes import task_mistakes

if TYPE_CHECKING:
    from worker.tasks.run.task import Task

_PUBLIC = {
    "worker.settings.task": ("Randomization", "STRICT", "TaskConfig", "reward_weights"),
    "worker.tasks.declare.declaration": (
        *(
            "Action",
            "Adaptive",
            "Choice",
            "Command",
            "Curriculum",
            "Declaration",
            "Event",
            "Image",
            "Metric",
            "Observation",
            "Reward",
            "Term",
        ),
        "Termination",
    ),
    "worker.tasks.run.declared": ("DeclaredTask",),
    "worker.simulation.declared_randomization": ("Randomize",),
    "worker.tasks.run.task": ("Task",),
    "worker.tasks.declare.term_needs": ("needs",),
    "worker.simulation.actuators": (
        *("DCMotorActuator", "EffortActuator", "ExplicitPDActuator", "PositionActuator", "VelocityActuator"),
    ),
    "worker.simulation.collisions": ("Collision",),
    "worker.simulation.episodes": ("EpisodeArrays", "numbered_stream", "random_stream"),
    "worker.simulation.objects": ("Box", "Capsule", "Sphere"),
    "worker.simulation.robot": ("Robot",),
    "worker.simulation.robot_arrays": ("BodyArrays", "RobotArrays"),
    "worker.simulation.sensors.camera": ("CameraArrays", "CameraSensor"),
    "worker.simulation.sensors.contact": ("ContactArrays", "ContactSensor"),
    "worker.simulation.sensors.differential_ik": ("DifferentialIK", "IkArrays"),
    "worker.simulation.sensors.frames": ("FrameArrays", "Frames"),
    "worker.simulation.sensors.height_scan": ("GridPattern", "HeightScan", "HeightScanArrays", "RingPattern"),
    "worker.simulation.sensors.imu": ("Imu", "ImuArrays"),
    "worker.simulation.sensors.momentum": ("AngularMomentum", "MomentumArrays"),
    "worker.simulation.sensors.rays": ("LidarPattern", "RayArrays", "RayCaster"),
    "worker.simulation.sensors.selection": ("ObjectSelection", "SelectionArrays"),
    "worker.simulation.sensors.wrench": ("ExternalWrench", "WrenchArrays"),
    "worker.simulation.terrain": ("Terrain",),
    "worker.simulation.terrain_patches": (
        *("Flat", "Gaps", "Grid", "Patch", "Rough", "Slope", "Stairs", "Steps", "Stones", "Waves"),
    ),
    "worker.simulation.terrain_arrays": ("TerrainArrays",),
    "worker.simulation.worlds": ("WorldArrays",),
}
"""Public names by their module."""
_MODULE_OF = {name: module for module, names in _PUBLIC.items() for name in names}


def __getattr__(name: str) -> Any:
    if name == "terms":
        return importlib.import_module("worker.tasks.terms")
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_MODULE_OF[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *_MODULE_OF, "terms"})


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
    found = {point.name: point.value for point in entry_points(group="muster.tasks")}
    return dict(sorted((BUILT_IN | found).items()))


def find_task(name: str) -> type[Task]:
    """The class of a task.

    Args:
        name: A built-in task, one that an installed package offers under the entry point group ``muster.tasks``, or
            ``module:Class``.

    Raises:
        ValueError: The task does not exist, the class is not a task, or the user's module can't be imported.
    """
    known = task_names()
    where = name if ":" in name else known.get(name)
    if where is None:
        raise ValueError(f"no task is called {name!r}; {nearest(name, known)} (your own: module:Class)")
    module_name, _, class_name = where.partition(":")
    if name == where and os.getcwd() not in sys.path:
        sys.path.append(
            os.getcwd()
        )  # a user's module is in the submitter's directory; last, so that it hides none of ours
    try:
        with task_mistakes(name):
            module = importlib.import_module(module_name)
    except ModuleNotFoundError as error:
        if error.name is None or not (module_name == error.name or module_name.startswith(error.name + ".")):
            raise
        raise ValueError(
            f"task {name!r}: there is no module {module_name!r} on the path, nor in {os.getcwd()}"
        ) from error
    found = getattr(module, class_name, None)
    from worker.tasks.run.task import Task

    if not (isinstance(found, type) and issubclass(found, Task)):
        classes = [each for each in vars(module).values() if isinstance(each, type) and each.__module__ == module_name]
        there = nearest(class_name, [each.__name__ for each in classes if issubclass(each, Task)])
        raise ValueError(
            f"task {name!r}: {module_name} has no class {class_name!r} that is a worker.tasks.run.task.Task; {there}"
        )
    return found
