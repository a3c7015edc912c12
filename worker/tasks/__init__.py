"""Tasks: find one by name, and the public parts of a task of your own.

The names here are public: ``from worker.tasks import Task, Declaration, Robot, terms``. Each is imported on first use,
because most of them import the simulation.
"""

from __future__ import annotations

import importlib
from typing import Any

from worker.tasks.run.find import find_task as find_task
from worker.tasks.run.find import task_names as task_names

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
    if name == "DeclaredTask":  # its former name
        name = "Task"
    if name == "terms":
        return importlib.import_module("worker.tasks.terms")
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_MODULE_OF[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *_MODULE_OF, "terms"})
