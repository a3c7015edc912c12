"""Differences in dynamics that no field of a robot's model shows: other accelerations, and constraints of another softness."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import mujoco
import numpy as np

from worker.simulation.robot_twins import Twins
from worker.simulation.robot_values import UNLIMITED, freedoms, matrix, move_joint

RELATIVE = 1e-6
"""Two values are equal up to this share of the greater one: Newton computes in float32."""
ACCELERATION = 1e-3
"""Accelerations in the same state, and inverse weights, are equal up to this share of the greatest one."""
Found = tuple[str, str, Any, Any]
"""Element, field, and its values in the built robot and in the file, as of :class:`worker.simulation.robot_comparison.RobotDifference`."""


def dynamics(twins: Twins, options: bool) -> Iterator[Found]:
    """Compare two models that have the same fields.

    Args:
        twins: Both models.
        options: Whether the medium and the flags of the file count.
    """
    yield from _softness(twins)
    yield from _accelerations(twins, options)


def _softness(twins: Twins) -> Iterator[Found]:
    """Bodies of other inverse weights, by which MuJoCo scales how soft contacts and equalities are."""
    rounding = RELATIVE * twins.file.body_invweight0.max(0)
    for body in sorted(twins.held_bodies()):
        twin = twins.bodies[body]
        mine, theirs = twins.built.body_invweight0[twin], twins.file.body_invweight0[body]
        if not (np.abs(mine - theirs) <= rounding + ACCELERATION * np.maximum(mine, theirs)).all():
            yield twins.name("body", body), "softness of contacts", mine, theirs


def _accelerations(twins: Twins, options: bool) -> Iterator[Found]:
    """What no field shows: the first joint with another acceleration in one of three states, without contacts."""
    random = np.random.default_rng(0)
    file, built = twins.free_of_contacts(options)
    for trial in range(3):
        first, second = mujoco.MjData(file), mujoco.MjData(built)
        for joint, twin in twins.joints.items():
            move_joint(((file, first, joint), (built, second, twin)), 0.1 * trial, random)
        first.ctrl[:] = second.ctrl[:] = random.uniform(-0.5, 0.5, file.nu)
        first.act[:] = second.act[:] = random.uniform(0.0, 0.5, file.na)
        mujoco.mj_forward(file, first)
        mujoco.mj_forward(built, second)
        scale = max(1.0, float(np.abs(first.qacc).max(initial=0.0)))
        for joint, twin in twins.joints.items():
            width = freedoms(file, joint)
            theirs = first.qacc[file.jnt_dofadr[joint] :][:width]
            mine = second.qacc[built.jnt_dofadr[twin] :][:width]
            if not (np.abs(theirs - mine) <= ACCELERATION * scale).all():
                forces = np.abs(first.qfrc_actuator)
                if forces.max(initial=0.0) > UNLIMITED:
                    strongest = int(file.dof_jntid[forces.argmax()])
                    yield twins.name("joint", strongest), "greatest force of actuators", UNLIMITED, float(forces.max())
                    return
                unexplained = (twins.name("joint", joint), "acceleration in the same state", mine, theirs)
                yield next(_inertia_axes(twins), unexplained)
                return


def _inertia_axes(twins: Twins) -> Iterator[Found]:
    """Bodies whose drag differs, since a medium acts on the axes of their inertias: Newton keeps no axes of equal moments."""
    for body, twin in twins.bodies.items() if twins.file.opt.density else ():
        theirs, mine = matrix(twins.file.body_iquat[body]), matrix(twins.built.body_iquat[twin])
        if twins.file.body_mass[body] and (np.abs(theirs.T @ mine).max(0) < 1.0 - RELATIVE).any():
            yield twins.name("body", body), "axes of inertia", mine, theirs
