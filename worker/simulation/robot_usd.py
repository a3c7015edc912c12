"""What USD's own schema says of a robot, compared with what Newton's importer built of it.

Only values that the file gives are compared. Those that the builder can hold are corrected in it; the others are differences.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from fnmatch import fnmatchcase

import newton
from newton.usd import PrimType, SchemaResolverMjc, SchemaResolverNewton, SchemaResolverPhysx
from pxr import Usd, UsdGeom, UsdPhysics

from worker.simulation import robot_usd_bodies, robot_usd_joints
from worker.simulation.patterns import check_ignored
from worker.simulation.robot_comparison import Comparison, RobotDifference, matches
from worker.simulation.robot_elements import some
from worker.simulation.robot_usd_stage import RELATIVE, UsdStage


class _Physx(SchemaResolverPhysx):
    """Of PhysX's schema what another solver can hold: rotors, joint positions, and whether an articulation's bodies collide."""

    mapping = {
        PrimType.JOINT: {
            key: attribute
            for key, attribute in SchemaResolverPhysx.mapping[PrimType.JOINT].items()
            if key == "armature" or key.endswith("_position")
        },
        PrimType.ARTICULATION: SchemaResolverPhysx.mapping[PrimType.ARTICULATION],
    }


SCHEMAS = (SchemaResolverNewton(), SchemaResolverMjc(), _Physx())
"""Schemas beside USD's own that the importer reads, the first with a value wins."""


def judge(
    path: str, builder: newton.ModelBuilder, ignored: Sequence[str], shown: str, accept: Sequence[str]
) -> tuple[Comparison, tuple[RobotDifference, ...]]:
    """Compare a builder of one robot with its USD file, and correct it.

    Args:
        path: The file.
        builder: Holds the robot alone, as imported, with its drives as actuators.
        ignored: Patterns of the names of prims that were left out.
        shown: The file's name, for errors.
        accept: Patterns of differences that do not count, ``"ELEMENT: FIELD"``.

    Returns:
        What differs still, and what was corrected.

    Raises:
        ValueError: A body or a joint is missing or makes no tree, a value makes no sense, or the file's units are not metres and
            kilograms.
    """
    stage = Usd.Stage.Open(path)
    for name, unit in (
        ("metersPerUnit", UsdGeom.GetStageMetersPerUnit(stage)),
        ("kilogramsPerUnit", UsdPhysics.GetStageKilogramsPerUnit(stage)),
    ):
        if not math.isclose(unit, 1.0, rel_tol=RELATIVE):
            raise ValueError(f"{shown}: {name} is {unit:g}; export the file in metres and kilograms ({name} = 1)")
    every = [*Usd.PrimRange(stage.GetPseudoRoot(), Usd.TraverseInstanceProxies())]
    check_ignored([prim.GetName() for prim in every], ignored, f"prim of {shown}")
    prims = [prim for prim in every if not any(fnmatchcase(prim.GetName(), each) for each in ignored)]
    joints = [prim for prim in prims if prim.IsA(UsdPhysics.Joint)]
    if joints and not any(prim.HasAPI(UsdPhysics.ArticulationRootAPI) for prim in prims):
        raise ValueError(
            f"{shown}: its joints ({some([prim.GetName() for prim in joints])}) belong to no articulation; apply "
            "PhysicsArticulationRootAPI to the prim above the robot"
        )
    both = UsdStage(stage, shown, prims, builder)
    faults = [*robot_usd_bodies.faults(both), *robot_usd_joints.faults(both)]
    if faults:
        raise ValueError(f"{shown} can't be held: {some(faults)}; change the file, or export it as MJCF or URDF")
    robot_usd_bodies.compare(both)
    robot_usd_joints.compare(both)
    counting = [each for each in both.differences if not matches(each, accept)]
    accepted = tuple(each for each in both.differences if matches(each, accept))
    return Comparison(tuple(counting), tuple(both.notes), {}, accepted=accepted), tuple(both.corrected)
