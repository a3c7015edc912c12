"""What USD's own schema says of a robot, compared with what Newton's importer built of it.

Only values that the file gives are compared. Those that the builder can hold are corrected in it; the others are differences.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from fnmatch import fnmatchcase
from typing import Any

import newton
import numpy as np
import warp as wp
from newton.usd import PrimType, SchemaResolverMjc, SchemaResolverNewton, SchemaResolverPhysx
from pxr import Usd, UsdGeom, UsdPhysics, UsdShade

from worker.simulation import robot_usd_joints
from worker.simulation.patterns import check_ignored
from worker.simulation.robot_comparison import Comparison, RobotDifference, matches
from worker.simulation.robot_elements import some
from worker.simulation.robot_usd_stage import RELATIVE, UsdStage, authored, quaternion, same_pose


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
    """Compare a builder of one robot, as imported and with its drives as actuators, with its USD file, and correct it.

    Returns:
        What differs still, where not accepted as ``"ELEMENT: FIELD"``, and what was corrected.

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
    faults = [*_body_faults(both), *robot_usd_joints.faults(both)]
    if faults:
        raise ValueError(f"{shown} can't be held: {some(faults)}; change the file, or export it as MJCF or URDF")
    _compare_bodies(both)
    robot_usd_joints.compare(both)
    counting = [each for each in both.differences if not matches(each, accept)]
    accepted = tuple(each for each in both.differences if matches(each, accept))
    return Comparison(tuple(counting), tuple(both.notes), {}, accepted=accepted), tuple(both.corrected)


def _body_faults(both: UsdStage) -> Iterator[str]:
    """Bodies that are missing, or whose masses make no sense."""
    builder = both.builder
    moving = {child for child, dofs in zip(builder.joint_child, builder.joint_dof_dim, strict=True) if sum(dofs)}
    for prim in _bodies(both):
        path = str(prim.GetPath())
        index, mass = both.bodies.get(path), authored(prim, "physics:mass") or 0.0
        moments = sorted(authored(prim, "physics:diagonalInertia") or (0.0,))
        if index is None:
            yield f"body {path} is missing"
        elif mass < 0.0 or not math.isfinite(mass):
            yield f"body {path}: its mass is {mass:g}, which no body has"
        elif index in moving and not builder.body_mass[index] > 0.0:
            yield f"body {path} moves and has no mass"
        elif any(moments) and not (moments[0] > 0.0 and moments[2] <= (moments[0] + moments[1]) * (1.0 + 1e-5)):
            shown = " ".join(f"{moment:g}" for moment in moments)
            yield f"body {path}: its moments of inertia {shown} are those of no body (each is at most the sum of the others)"


def _compare_bodies(both: UsdStage) -> None:
    """Correct places, masses, inertias, colliders and friction; name what can't be held."""
    for prim in _bodies(both):
        _compare_body(both, prim)
    shapes: dict[str, int] = {label: index for index, label in enumerate(both.builder.shape_label)}
    for prim in both.prims:
        if prim.HasAPI(UsdPhysics.CollisionAPI):
            _compare_collider(both, prim, shapes)


def _bodies(both: UsdStage) -> Iterator[Any]:
    for prim in both.prims:
        if prim.HasAPI(UsdPhysics.RigidBodyAPI) and UsdPhysics.RigidBodyAPI(prim).GetRigidBodyEnabledAttr().Get():
            yield prim


def _compare_body(both: UsdStage, prim: Any) -> None:
    path, builder = str(prim.GetPath()), both.builder
    element, index = f"body {path}", both.bodies[path]
    place, pose = wp.transform(*builder.body_q[index]), both.pose(prim)
    if not same_pose(place, pose):
        both.differ(element, "place", place, pose)
    if mass := authored(prim, "physics:mass"):
        both.correct(element, "physics:mass", builder.body_mass, index, float(mass))
        builder.body_inv_mass[index] = 1.0 / mass
    center = authored(prim, "physics:centerOfMass")
    if center is not None and all(map(math.isfinite, center)):
        in_file = wp.transform_point(wp.transform_inverse(pose), both.point(prim, center))
        both.correct(
            element, "physics:centerOfMass", builder.body_com, index, in_file, within=1e-6 + 1e-5 * wp.length(in_file)
        )
    moments = authored(prim, "physics:diagonalInertia")
    if moments is not None and any(moments) and authored(prim, "newton:inertia") is None:
        axes = authored(prim, "physics:principalAxes")
        turned = axes is not None and (axes.GetReal() or any(axes.GetImaginary()))  # all 0: not given
        rotation = np.array(wp.quat_to_matrix(quaternion(axes) if turned else wp.quat_identity())).reshape(3, 3)
        tensor = wp.mat33(*(rotation @ np.diag(moments) @ rotation.T).ravel())
        both.correct(element, "physics:diagonalInertia", builder.body_inertia, index, tensor)
        builder.body_inv_inertia[index] = wp.mat33(*np.linalg.inv(np.array(tensor).reshape(3, 3)).ravel())


def _compare_collider(both: UsdStage, prim: Any, shapes: dict[str, int]) -> None:
    path, builder = str(prim.GetPath()), both.builder
    element, enabled = f"collider {path}", bool(UsdPhysics.CollisionAPI(prim).GetCollisionEnabledAttr().Get())
    mine = [index for label, index in shapes.items() if label == path or label.startswith(f"{path}/")]
    touching = int(newton.ShapeFlags.COLLIDE_SHAPES)
    if enabled and not any(builder.shape_flags[index] & touching for index in mine):
        both.differ(element, "physics:collisionEnabled", False, True)
    material = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial("physics")[0].GetPrim()
    if not enabled or not material or not material.HasAPI(UsdPhysics.MaterialAPI):
        return
    friction, still = (authored(material, f"physics:{name}Friction") for name in ("dynamic", "static"))
    bounce = authored(material, "physics:restitution")
    for index in mine:
        if friction is not None:
            both.correct(element, "physics:dynamicFriction", builder.shape_material_mu, index, float(friction))
        if bounce is not None:
            both.correct(element, "physics:restitution", builder.shape_material_restitution, index, float(bounce))
    element = f"material {material.GetPath()}"
    if still is not None and friction is not None and still != friction:
        both.note(f"{element}: its static friction {still:g} is not held; contacts have one friction, {friction:g}")
    if bounce:
        both.note(f"{element}: its restitution {bounce:g} is not held; Collision(solref=…) makes contacts bounce")
