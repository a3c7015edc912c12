"""Worlds of robots, and those of the mjlab package (Apache-2.0), whose files it brings along, as MuJoCo itself builds them."""

from __future__ import annotations

import fnmatch
import importlib.util
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import mujoco
import newton
import numpy as np
import pytest

from tests.support.worker.robot_texts import template
from worker.simulation.actuators import PositionActuator
from worker.simulation.collisions import Collision
from worker.simulation.robot import Robot
from worker.simulation.worlds import Worlds

_WITHOUT_MJLAB = "the mjlab package, which has the robots' files, is not installed: make env installs it"
needs_mjlab = pytest.mark.skipif(importlib.util.find_spec("mjlab") is None, reason=_WITHOUT_MJLAB)


def need_mjlab() -> None:
    """Skip the test where the package with the robots' files is not installed."""
    if importlib.util.find_spec("mjlab") is None:
        pytest.skip(_WITHOUT_MJLAB)


def build(
    *items: Any, worlds: int = 1, ground: bool = True, timestep: float = 0.005, substeps: int = 1, **options: Any
) -> tuple[newton.ModelBuilder, Worlds]:
    """A template of these robots and objects, and its worlds on the processor."""
    scene = template(*items)
    built = Worlds(
        scene,
        worlds,
        "cpu",
        timestep=timestep,
        substeps=substeps,
        fastest=1e4,
        ground=ground,
        solver_options={"njmax": 300, "nconmax": 80, **options},
    )
    return scene, built


def reference(robot: Robot, timestep: float = 0.005) -> mujoco.MjModel:
    """The same robot, built by MuJoCo's own compiler from the same file and the same numbers."""
    package, _, inside = str(robot.file).partition(":")[2].partition("/")
    found = importlib.util.find_spec(package)
    assert found is not None and found.origin is not None
    spec = mujoco.MjSpec.from_file(str(Path(found.origin).parent / inside))
    for actuator in list(spec.actuators):
        spec.delete(actuator)
    for declared in robot.actuators:
        assert isinstance(declared, PositionActuator) and isinstance(declared.effort_limit, float)
        for joint in spec.joints:
            if joint.type == mujoco.mjtJoint.mjJNT_FREE or not _matches(joint.name, declared.joints):
                continue
            joint.armature = declared.armature
            made = spec.add_actuator(name=joint.name, target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
            made.set_to_position(kp=declared.stiffness, kv=declared.damping)
            made.ctrllimited = False
            made.forcelimited = True
            made.forcerange = [-declared.effort_limit, declared.effort_limit]
    for geom in spec.geoms:
        for collision in robot.collisions:
            _collide(geom, collision)
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[5, 5, 5])
    spec.option.timestep = timestep
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    return spec.compile()


def _matches(name: str, patterns: Any) -> bool:
    return any(fnmatch.fnmatchcase(name, one) for one in ([patterns] if isinstance(patterns, str) else patterns))


def _first(name: str, values: Any) -> Any:
    if not isinstance(values, Mapping):
        return values
    return next((value for pattern, value in values.items() if fnmatch.fnmatchcase(name, pattern)), None)


def _collide(geom: Any, collision: Collision) -> None:
    if not _matches(geom.name, collision.geoms):
        geom.contype = geom.conaffinity = 0
        return
    for name in ("contype", "conaffinity", "condim", "priority"):
        setattr(geom, name, _first(geom.name, getattr(collision, name)))
    friction = _first(geom.name, collision.friction)
    if friction is not None:
        supplied = np.atleast_1d(friction)
        geom.friction[: len(supplied)] = supplied
    if collision.solref is not None:
        geom.solref[:2] = collision.solref
