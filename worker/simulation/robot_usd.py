"""What USD's own schema says of a robot, compared with what Newton's importer built of it."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import newton
from pxr import Usd, UsdGeom, UsdPhysics

from worker.simulation.robot_elements import some

RELATIVE = 1e-5
"""Two values are equal up to this share of the greater one: USD keeps float32, and angles in degrees."""


def check(path: str, builder: newton.ModelBuilder, shown: str) -> None:
    """Compare a builder of one robot with the bodies and joints of its USD file.

    Args:
        path: The file.
        builder: Holds the robot alone, as imported.
        shown: The file's name, for errors.

    Raises:
        ValueError: A body or a joint is missing, or has another mass, body or limit than the schema says.
    """
    stage = Usd.Stage.Open(path)
    prims = list(Usd.PrimRange(stage.GetPseudoRoot(), Usd.TraverseInstanceProxies()))
    joints = [prim for prim in prims if prim.IsA(UsdPhysics.Joint)]
    if joints and not any(prim.HasAPI(UsdPhysics.ArticulationRootAPI) for prim in prims):
        raise ValueError(
            f"{shown}: its joints ({some([prim.GetName() for prim in joints])}) belong to no articulation; apply "
            "PhysicsArticulationRootAPI to the prim above the robot"
        )
    found = [*_bodies(stage, prims, builder), *_joints(stage, prims, builder)]
    if found:
        raise ValueError(
            f"{shown} would be another robot here: {some(found)}; change the file, or export it as MJCF or URDF"
        )


def _bodies(stage: Any, prims: list[Any], builder: newton.ModelBuilder) -> Iterator[str]:
    built = {label: index for index, label in enumerate(builder.body_label)}
    kilograms = UsdPhysics.GetStageKilogramsPerUnit(stage)
    for prim in prims:
        if (
            not prim.HasAPI(UsdPhysics.RigidBodyAPI)
            or not UsdPhysics.RigidBodyAPI(prim).GetRigidBodyEnabledAttr().Get()
        ):
            continue
        index = built.get(str(prim.GetPath()))
        if index is None:
            yield f"body {prim.GetName()} is missing"
            continue
        mass = UsdPhysics.MassAPI(prim).GetMassAttr().Get() if prim.HasAPI(UsdPhysics.MassAPI) else 0.0
        if mass and not _close(mass * kilograms, builder.body_mass[index]):
            yield f"body {prim.GetName()}: mass is {builder.body_mass[index]:.6g}, in the file {mass * kilograms:.6g}"


def _joints(stage: Any, prims: list[Any], builder: newton.ModelBuilder) -> Iterator[str]:
    built = {label: index for index, label in enumerate(builder.joint_label)}
    moved = {builder.body_label[child] for child in builder.joint_child}
    metres = UsdGeom.GetStageMetersPerUnit(stage)
    for prim in prims:
        joint = UsdPhysics.Joint(prim)
        if not joint or not joint.GetJointEnabledAttr().Get() or joint.GetExcludeFromArticulationAttr().Get():
            continue
        index = built.get(str(prim.GetPath()))
        ends = {str(path) for each in (joint.GetBody0Rel(), joint.GetBody1Rel()) for path in each.GetTargets()}
        is_loop = ends <= moved if index is None else builder.joint_articulation[index] < 0
        if is_loop and len(ends) == 2:
            yield f"joint {prim.GetName()} closes a loop, and joints make a tree here"
        elif index is None and not prim.IsA(UsdPhysics.FixedJoint):  # one to the world is the root of a fixed robot
            yield f"joint {prim.GetName()} is missing"
        if index is None:
            continue
        child = builder.body_label[builder.joint_child[index]]
        if ends and child not in ends:
            yield f"joint {prim.GetName()} moves {child.rpartition('/')[2]}, in the file one of {some(sorted(ends))}"
        for kind, unit in ((UsdPhysics.RevoluteJoint, math.pi / 180.0), (UsdPhysics.PrismaticJoint, metres)):
            if prim.IsA(kind):
                yield from _limits(kind(prim), unit, builder, index)


def _limits(joint: Any, unit: float, builder: newton.ModelBuilder, index: int) -> Iterator[str]:
    dof = builder.joint_qd_start[index]
    for name, limit, here in (
        ("lower", joint.GetLowerLimitAttr().Get(), builder.joint_limit_lower[dof]),
        ("upper", joint.GetUpperLimitAttr().Get(), builder.joint_limit_upper[dof]),
    ):
        there = limit * unit if limit is not None and math.isfinite(limit) else math.inf
        if not (_close(there, here) or (math.isinf(there) and abs(here) >= newton.MAXVAL)):
            yield f"joint {joint.GetPrim().GetName()}: its {name} limit is {here:.6g}, in the file {there:.6g}"


def _close(first: float, second: float) -> bool:
    return math.isclose(first, second, rel_tol=RELATIVE, abs_tol=1e-7)
