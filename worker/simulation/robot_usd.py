"""What USD's own schema says of a robot, compared with what Newton's importer built of it."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from typing import Any

import newton
from pxr import Usd, UsdGeom, UsdPhysics

from worker.simulation.robot_elements import some

RELATIVE = 1e-5
"""Two values are equal up to this share of the greater one: USD keeps float32, and angles in degrees."""


FREEDOMS = {"PhysicsRevoluteJoint": 1, "PhysicsPrismaticJoint": 1, "PhysicsSphericalJoint": 3, "PhysicsFixedJoint": 0}
"""Degrees of freedom by the type of a joint; of a plain PhysicsJoint there are six, less those that its limits lock."""


def check(path: str, builder: newton.ModelBuilder, ignored: Sequence[str], shown: str) -> None:
    """Compare a builder of one robot with the bodies and joints of its USD file.

    Args:
        path: The file.
        builder: Holds the robot alone, as imported.
        ignored: Regular expressions of the names of prims that were left out.
        shown: The file's name, for errors.

    Raises:
        ValueError: A body or a joint is missing, or has another mass, body, freedom or limit than the schema says; or the file's units
            are not metres and kilograms.
    """
    stage = Usd.Stage.Open(path)
    for name, unit in (
        ("metersPerUnit", UsdGeom.GetStageMetersPerUnit(stage)),
        ("kilogramsPerUnit", UsdPhysics.GetStageKilogramsPerUnit(stage)),
    ):
        if not _close(unit, 1.0):
            raise ValueError(f"{shown}: {name} is {unit:g}; export the file in metres and kilograms ({name} = 1)")
    every = Usd.PrimRange(stage.GetPseudoRoot(), Usd.TraverseInstanceProxies())
    prims = [prim for prim in every if not any(re.match(each, prim.GetName()) for each in ignored)]
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
    moving = {child for child, dofs in zip(builder.joint_child, builder.joint_dof_dim, strict=True) if sum(dofs)}
    for prim in prims:
        if not prim.HasAPI(UsdPhysics.RigidBodyAPI):
            continue
        if not UsdPhysics.RigidBodyAPI(prim).GetRigidBodyEnabledAttr().Get():
            continue
        name, index = prim.GetName(), built.get(str(prim.GetPath()))
        if index is None:
            yield f"body {name} is missing"
            continue
        mass = UsdPhysics.MassAPI(prim).GetMassAttr().Get() if prim.HasAPI(UsdPhysics.MassAPI) else 0.0
        if mass and not _close(mass, builder.body_mass[index]):
            yield f"body {name}: mass is {builder.body_mass[index]:.6g}, in the file {mass:.6g}"
        elif index in moving and not builder.body_mass[index] > 0.0:
            yield f"body {name} moves and has no mass"


def _joints(stage: Any, prims: list[Any], builder: newton.ModelBuilder) -> Iterator[str]:
    built = {label: index for index, label in enumerate(builder.joint_label)}
    moved = {builder.body_label[child] for child in builder.joint_child}
    for prim in prims:
        joint = UsdPhysics.Joint(prim)
        if not joint or not joint.GetJointEnabledAttr().Get() or joint.GetExcludeFromArticulationAttr().Get():
            continue
        name, index = prim.GetName(), built.get(str(prim.GetPath()))
        ends = {str(path) for each in (joint.GetBody0Rel(), joint.GetBody1Rel()) for path in each.GetTargets()}
        is_loop = ends <= moved if index is None else builder.joint_articulation[index] < 0
        if is_loop and len(ends) == 2:
            yield f"joint {name} closes a loop, and joints make a tree here"
        elif index is None and not prim.IsA(UsdPhysics.FixedJoint):  # one to the world is the root of a fixed robot
            yield f"joint {name} is missing"
        if index is None:
            continue
        child, freedoms = builder.body_label[builder.joint_child[index]], sum(builder.joint_dof_dim[index])
        if ends and child not in ends:
            yield f"joint {name} moves {child.rpartition('/')[2]}, in the file one of {some(sorted(ends))}"
        if freedoms != (there := _freedoms(prim)):
            yield f"joint {name} has {freedoms} degrees of freedom, in the file {there}"
        for kind, unit in ((UsdPhysics.RevoluteJoint, math.pi / 180.0), (UsdPhysics.PrismaticJoint, 1.0)):
            if prim.IsA(kind):
                yield from _limits(kind(prim), unit, builder, index)


def _freedoms(prim: Any) -> int:
    if prim.GetTypeName() in FREEDOMS:
        return FREEDOMS[prim.GetTypeName()]
    locked = 0
    for schema in prim.GetAppliedSchemas():
        kind, _, axis = schema.partition(":")
        if kind == "PhysicsLimitAPI" and axis != "distance":
            limit = UsdPhysics.LimitAPI(prim, axis)
            low, high = limit.GetLowAttr().Get(), limit.GetHighAttr().Get()
            locked += low is not None and high is not None and low > high
    return 6 - locked


def _limits(joint: Any, unit: float, builder: newton.ModelBuilder, index: int) -> Iterator[str]:
    dof, name = builder.joint_qd_start[index], joint.GetPrim().GetName()
    lower, upper = joint.GetLowerLimitAttr().Get(), joint.GetUpperLimitAttr().Get()
    if lower is not None and upper is not None and not lower <= upper:
        yield f"joint {name}: its limits {lower:g} and {upper:g} are no range"
        return
    for word, limit, here in (
        ("lower", lower, builder.joint_limit_lower[dof]),
        ("upper", upper, builder.joint_limit_upper[dof]),
    ):
        there = limit * unit if limit is not None and math.isfinite(limit) else math.inf
        if not (_close(there, here) or (math.isinf(there) and abs(here) >= newton.MAXVAL)):
            yield f"joint {name}: its {word} limit is {here:.6g}, in the file {there:.6g}"


def _close(first: float, second: float) -> bool:
    return math.isclose(first, second, rel_tol=RELATIVE, abs_tol=1e-7)
