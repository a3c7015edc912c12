"""Robots of the mjlab package (Apache-2.0), whose files it brings along: as declared here, and as MuJoCo itself builds them."""

from __future__ import annotations

import fnmatch
import importlib.util
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import mujoco
import newton
import numpy as np
import pytest
from newton.solvers import SolverMuJoCo

from worker.simulation.actuators import PositionActuator
from worker.simulation.collisions import Collision
from worker.simulation.robot import Robot
from worker.simulation.worlds import Worlds

NATURAL = 20 * math.pi
"""Natural frequency of the servos [rad/s]."""


def _servo(joints: tuple[str, ...] | str, armature: float, effort: float) -> PositionActuator:
    """mjlab's choice of gains: 10 Hz, twice critically damped."""
    return PositionActuator(
        joints, armature * NATURAL**2, 4 * armature * NATURAL, effort_limit=effort, armature=armature
    )


GO1 = Robot(
    "package:mjlab/asset_zoo/robots/unitree_go1/xmls/go1.xml",
    position=(0.0, 0.0, 0.278),
    joint_positions={"*thigh_joint": 0.9, "*calf_joint": -1.8, "*R_hip_joint": 0.1, "*L_hip_joint": -0.1},
    actuators=(
        _servo(("*_hip_joint", "*_thigh_joint"), 0.000111842 * 36, 23.7),
        _servo("*_calf_joint", 0.000111842 * 81, 35.55),
    ),
    collisions=(
        Collision(
            "*_collision*",
            condim={"*_foot_collision": 6, "*": 1},
            priority={"*_foot_collision": 1, "*": 0},
            friction={"*_foot_collision": (1.0, 5e-3, 5e-4)},
            solref=(0.01, 1.0),
        ),
    ),
    visuals=False,
)
FOOT = "*_foot[1-7]_collision"
G1 = Robot(
    "package:mjlab/asset_zoo/robots/unitree_g1/xmls/g1.xml",
    position=(0.0, 0.0, 0.76),
    joint_positions={
        "*_hip_pitch_joint": -0.312,
        "*_knee_joint": 0.669,
        "*_ankle_pitch_joint": -0.363,
        "*_elbow_joint": 0.6,
        "left_shoulder_roll_joint": 0.2,
        "right_shoulder_roll_joint": -0.2,
        "*_shoulder_pitch_joint": 0.2,
    },
    actuators=(
        _servo(("*_elbow_joint", "*_shoulder_*_joint", "*_wrist_roll_joint"), 0.0036, 25.0),
        _servo(("*_hip_pitch_joint", "*_hip_yaw_joint", "waist_yaw_joint"), 0.0102, 88.0),
        _servo(("*_hip_roll_joint", "*_knee_joint"), 0.0251, 139.0),
        _servo(("*_wrist_pitch_joint", "*_wrist_yaw_joint"), 0.00425, 5.0),
        _servo(("waist_pitch_joint", "waist_roll_joint", "*_ankle_*_joint"), 0.0072, 50.0),
    ),
    collisions=(Collision("*_collision", condim={FOOT: 3, "*": 1}, priority={FOOT: 1, "*": 0}, friction={FOOT: 0.6}),),
    visuals=False,
)


def need_mjlab() -> None:
    """Skip the test where the package with the robots' files is not installed."""
    if importlib.util.find_spec("mjlab") is None:
        pytest.skip("the mjlab package, which has the robots' files, is not installed: make env installs it")


def build(
    *things: Any, worlds: int = 1, ground: bool = True, timestep: float = 0.005, substeps: int = 1, **options: Any
) -> tuple[newton.ModelBuilder, Worlds]:
    """A template of these robots and objects, and its worlds on the processor."""
    template = newton.ModelBuilder()
    SolverMuJoCo.register_custom_attributes(template)
    for thing in things:
        thing.add_to(template)
    built = Worlds(
        template,
        worlds,
        "cpu",
        timestep=timestep,
        substeps=substeps,
        fastest=1e4,
        ground=ground,
        solver_options={"njmax": 300, "nconmax": 80, **options},
    )
    return template, built


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
        given = np.atleast_1d(friction)
        geom.friction[: len(given)] = given
    if collision.solref is not None:
        geom.solref[:2] = collision.solref
