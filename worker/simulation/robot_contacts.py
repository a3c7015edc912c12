"""Contacts that a built robot has otherwise than its file, by the rules of Newton and MuJoCo-Warp; what is noted and not refused."""

from __future__ import annotations

from collections.abc import Iterator

import mujoco
import numpy as np

from worker.simulation.robot_elements import some, word_of
from worker.simulation.robot_twins import Twins
from worker.simulation.robot_values import freedoms, has_mask, touching

FLAT = ("mesh", "cylinder")
"""Without ``multiccd``, MuJoCo-Warp finds one contact of such a geom with a geom that is not a plane."""
MULTICCD = int(mujoco.mjtDisableBit.mjDSBL_MULTICCD)


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
