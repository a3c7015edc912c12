"""Behavior of a built robot that differs from its file though no field of its model shows it: contacts, accelerations, softness.

Contacts that the rules of Newton and MuJoCo-Warp change are noted and not refused.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import mujoco
import numpy as np

from worker.simulation.robot_elements import matrix, some, word_of
from worker.simulation.robot_twins import Twins
from worker.simulation.robot_values import UNLIMITED, freedoms, has_mask, move_joint, touching

FLAT = ("mesh", "cylinder")
"""Without ``multiccd``, MuJoCo-Warp finds one contact of such a geom with a geom that is not a plane."""
MULTICCD = int(mujoco.mjtDisableBit.mjDSBL_MULTICCD)
RELATIVE = 1e-6
"""Two values are equal up to this share of the greater one: Newton computes in float32."""
ACCELERATION = 1e-3
"""Accelerations in the same state, and inverse weights, are equal up to this share of the greatest one."""
Found = tuple[str, str, Any, Any]
"""Element, field, and its values in the built robot and in the file, as of :class:`worker.simulation.robot_comparison.RobotDifference`."""


def lost_margin(twins: Twins, kind: str, index: int, twin: int) -> bool:
    """Whether Newton set the margin of a geom or a contact pair to 0, which a note says."""
    field = f"{kind}_margin"
    return bool(getattr(twins.file, field)[index] and not getattr(twins.built, field)[twin])


def differing(twins: Twins) -> Iterator[tuple[tuple[int, int], bool]]:
    """Pairs of the file's geoms that can touch in only one of the models, and whether that is the built one."""
    geoms, others = list(twins.geoms), list(twins.geoms.values())
    theirs, mine = touching(twins.file)[np.ix_(geoms, geoms)], touching(twins.built)[np.ix_(others, others)]
    welded = twins.file.body_weldid[twins.file.geom_bodyid]
    for first, second in np.argwhere(np.triu(theirs != mine)):
        pair = geoms[first], geoms[second]
        if welded[pair[0]] or welded[pair[1]]:  # else neither can move
            yield pair, bool(mine[first, second])


def stay_apart(twins: Twins, pair: tuple[int, int]) -> bool:
    """Whether it is Newton's rule that two geoms never touch: a joint or an equality connects their bodies."""
    ends = frozenset(int(twins.file.body_weldid[twins.file.geom_bodyid[geom]]) for geom in pair)
    return 0 in ends or ends in twins.joined()


def notes(twins: Twins) -> Iterator[str]:
    """What a user should know of how a robot differs from its file, one sentence each."""
    file = twins.file
    single = [joint for joint in range(file.njnt) if freedoms(file, joint) == 1]
    if shifted := [joint for joint in single if file.qpos0[file.jnt_qposadr[joint]]]:
        names = some([f"{twins.name('joint', each)}: {file.qpos0[file.jnt_qposadr[each]]:.6g}" for each in shifted])
        yield f"positions and limits of joints count from their ref in the file, which is 0 here ({names})"
    bare = [
        twins.name("geom", geom)
        for geom, twin in twins.geoms.items()
        if has_mask(file, geom) and lost_margin(twins, "geom", geom, twin)
    ]
    bare += [
        f"contact pair {pair}" for pair, twin in twins.contact_pairs.items() if lost_margin(twins, "pair", pair, twin)
    ]
    if bare:
        yield (
            f"contacts begin where geoms touch, not at the margin of the file ({some(bare)}): "
            "Newton leaves out the margins of all geoms where one is a box or, with multiccd, a mesh"
        )
    kinds = [word_of(mujoco.mjtGeom, kind) for kind in file.geom_type]
    flat = sorted(
        {
            twins.name("geom", geom)
            for geom, other in np.argwhere(touching(file))
            if kinds[geom] in FLAT and kinds[other] in (*FLAT, "box", "capsule")
        }
    )
    if flat and twins.built.opt.disableflags & MULTICCD and not file.opt.disableflags & MULTICCD:
        yield (
            f"where meshes and cylinders touch each other, boxes or capsules, they have one contact, in MuJoCo several ({some(flat)}); "
            'solver_options={"enable_multiccd": True} finds them all'
        )
    apart = [pair for pair, mine in differing(twins) if not mine and stay_apart(twins, pair)]
    if apart:
        names = some([" and ".join(twins.name("geom", geom) for geom in pair) for pair in apart])
        yield f"bodies that a joint or an equality connects do not touch, even if one is fixed to the world ({names})"


def dynamics(twins: Twins, options: bool) -> Iterator[Found]:
    """Compare two models that have the same fields; ``options``: whether the medium and the flags of the file count."""
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
