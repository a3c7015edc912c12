"""Joints and their drives: USD's schema against Newton's builder."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from typing import Any

import newton
import numpy as np
import warp as wp
from pxr import UsdPhysics

from shared_store.contract.error_text import nearest
from worker.simulation.robot_elements import some
from worker.simulation.robot_usd_stage import PLACE, UsdStage, authored, plain, same, same_pose
from worker.simulation.robot_view import actuator_value, actuators_of_dofs

FREEDOMS = {"PhysicsRevoluteJoint": 1, "PhysicsPrismaticJoint": 1, "PhysicsSphericalJoint": 3, "PhysicsFixedJoint": 0}
"""Degrees of freedom by the type of a joint; of a plain PhysicsJoint there are six, less those that its limits lock."""
DEGREE = math.pi / 180.0
ANGULAR = ("angular", "rotX", "rotY", "rotZ")
"""Degrees of freedom whose limits and drives USD gives in degrees."""
STATE = re.compile(r"(state:\w+:physics|newton:\w+):position")
"""Attributes that give a joint's position at the start."""
NUMBERS = {
    "joint_armature": ("armature", "newton:armature", "mjc:armature", "physxJoint:armature"),
    "joint_friction": ("friction", "newton:friction", "mjc:frictionloss"),
}
"""The builder's list, the word for a sentence, and the attributes of the schemas, of which the first one counts."""


def faults(both: UsdStage) -> Iterator[str]:
    """Joints that are missing, that make no tree, or whose limits are not a range."""
    builder = both.builder
    moved = {builder.body_label[child] for child in builder.joint_child}
    pairs: dict[tuple[str, ...], str] = {}
    for prim in _joints(both):
        joint, path = UsdPhysics.Joint(prim), str(prim.GetPath())
        targets = [relation.GetTargets() for relation in (joint.GetBody0Rel(), joint.GetBody1Rel())]
        owners = [both.owner(each) for each in targets]
        ends = tuple(sorted(str(each.GetPath()) for each in owners if each))
        index, twin = both.joints.get(path), pairs.setdefault(ends, path)
        lost = [str(end) for each in targets for end in each if not both.stage.GetPrimAtPath(end)]
        bodies = {end: UsdPhysics.RigidBodyAPI(both.stage.GetPrimAtPath(end)) for end in ends}
        off = [end for end, body in bodies.items() if not body.GetRigidBodyEnabledAttr().Get()]
        limits = [authored(prim, f"physics:{word}Limit") for word in ("lower", "upper")]
        if lost:
            yield f"joint {path} holds {lost[0]}, which does not exist; {nearest(lost[0], sorted(both.bodies))}"
        elif off:
            yield f"joint {path} holds the body {off[0]}, which is disabled (physics:rigidBodyEnabled = 0)"
        elif joint.GetExcludeFromArticulationAttr().Get():
            both.note(f"joint {path} closes a loop, in which its limits and its drive are not held")
        elif twin != path:
            yield f"joints {twin} and {path} stand between the same bodies, and a body has one joint here"
        elif (set(ends) <= moved if index is None else builder.joint_articulation[index] < 0) and len(ends) == 2:
            yield f"joint {path} closes a loop, and joints make a tree here (physics:excludeFromArticulation = 1 opens it)"
        elif index is None and not prim.IsA(UsdPhysics.FixedJoint):  # one to the world is the root of a fixed robot
            yield f"joint {path} is missing"
        elif None not in limits and not limits[0] <= limits[1]:
            yield f"joint {path}: its limits {limits[0]:g} and {limits[1]:g} are not a range"
        elif index is not None:
            child, count = builder.body_label[builder.joint_child[index]], sum(builder.joint_dof_dim[index])
            if ends and child not in ends:
                yield f"joint {path} moves {child}, in the file one of {some([*ends])}"
            if count != (in_file := _freedoms(prim)):
                yield f"joint {path} has {count} degrees of freedom, in the file {in_file}"


def compare(both: UsdStage) -> None:
    """Correct frames, axes, limits, positions and rotors of joints; name what can't be held."""
    drives = actuators_of_dofs(both.builder)
    for prim in _joints(both):
        index = both.joints.get(str(prim.GetPath()))
        if index is None:
            continue
        reversed_ = _compare_frames(both, prim, index)
        if UsdPhysics.Joint(prim).GetExcludeFromArticulationAttr().Get():
            continue
        _compare_axes(both, prim, index, reversed_)
        _compare_position(both, prim, index)
        for dof, freedom in _dofs(both, prim, index):
            _compare_limits(both, prim, dof, freedom)
            _compare_numbers(both, prim, dof, freedom)
            _compare_drive(both, prim, dof, freedom, drives.get(dof))
        if coefficient := authored(prim, "physxJoint:jointFriction"):
            both.note(
                f"joint {prim.GetPath()}: PhysX's coefficient of friction {coefficient:g} is not held (friction_loss is)"
            )
        if UsdPhysics.Joint(prim).GetCollisionEnabledAttr().Get() and both.builder.joint_parent[index] >= 0:
            both.note(
                f"joint {prim.GetPath()}: contacts of the bodies that it joins (physics:collisionEnabled) are not held"
            )


def _joints(both: UsdStage) -> Iterator[Any]:
    for prim in both.prims:
        joint = UsdPhysics.Joint(prim)
        equality = any(schema.startswith("MjcEquality") for schema in prim.GetAppliedSchemas())
        if joint and joint.GetJointEnabledAttr().Get() and not equality:
            yield prim


def _freedoms(prim: Any) -> int:
    if prim.GetTypeName() in FREEDOMS:
        return FREEDOMS[prim.GetTypeName()]
    locked = 0
    for schema in prim.GetAppliedSchemas():
        kind, _, freedom = schema.partition(":")
        if kind == "PhysicsLimitAPI" and freedom != "distance":
            limit = UsdPhysics.LimitAPI(prim, freedom)
            low, high = limit.GetLowAttr().Get(), limit.GetHighAttr().Get()
            locked += low is not None and high is not None and low >= high
    return 6 - locked


def _dofs(both: UsdStage, prim: Any, index: int) -> Iterator[tuple[int, str]]:
    """Columns of a joint's degrees of freedom, and their names in USD's schema."""
    builder = both.builder
    first, (linear, angular) = builder.joint_qd_start[index], builder.joint_dof_dim[index]
    for dof in range(first, first + linear + angular):
        if prim.IsA(UsdPhysics.RevoluteJoint) or prim.IsA(UsdPhysics.PrismaticJoint):
            yield dof, "angular" if prim.IsA(UsdPhysics.RevoluteJoint) else "linear"
        elif prim.GetTypeName() == "PhysicsJoint":
            letter = "XYZ"[int(np.argmax(np.abs(plain(builder.joint_axis[dof]))))]
            yield dof, ("trans" if dof - first < linear else "rot") + letter


def _compare_frames(both: UsdStage, prim: Any, index: int) -> bool:
    """Correct where a joint is on its two bodies; returns whether it moves the first of them, against USD's order."""
    builder, joint, element = both.builder, UsdPhysics.Joint(prim), f"joint {prim.GetPath()}"
    ends = [
        (joint.GetBody0Rel(), joint.GetLocalPos0Attr(), joint.GetLocalRot0Attr(), "0"),
        (joint.GetBody1Rel(), joint.GetLocalPos1Attr(), joint.GetLocalRot1Attr(), "1"),
    ]
    first = both.owner(ends[0][0].GetTargets())
    reversed_ = bool(first) and str(first.GetPath()) == builder.body_label[builder.joint_child[index]]
    parent, child = ends[::-1] if reversed_ else ends
    for (relation, position, rotation, end), frames, body in (
        (parent, builder.joint_X_p, builder.joint_parent[index]),
        (child, builder.joint_X_c, builder.joint_child[index]),
    ):
        if body < 0 or not relation.GetTargets():
            continue  # on the world's side tools write many things: the place of the body is compared
        target = both.stage.GetPrimAtPath(relation.GetTargets()[0])
        frame = both.pose(target, position.Get(), rotation.Get())
        in_file = wp.transform_inverse(wp.transform(*builder.body_q[body])) * frame
        if not same_pose(wp.transform(*frames[index]), in_file):
            both.correct(element, f"physics:localPos{end} and localRot{end}", frames, index, in_file)
    return reversed_


def _compare_axes(both: UsdStage, prim: Any, index: int, reversed_: bool) -> None:
    builder, element = both.builder, f"joint {prim.GetPath()}"
    axis = prim.GetAttribute("physics:axis").Get() if prim.HasAttribute("physics:axis") else None
    if sum(builder.joint_dof_dim[index]) == 1 and axis:
        in_file = wp.vec3(*((-1.0 if reversed_ else 1.0) if axis == letter else 0.0 for letter in "XYZ"))
        both.correct(element, "physics:axis", builder.joint_axis, builder.joint_qd_start[index], in_file)
    elif sum(builder.joint_dof_dim[index]) > 1 and reversed_:
        moved = builder.body_label[builder.joint_child[index]]
        both.differ(element, "the body that it moves", moved, "the other one")


def _compare_position(both: UsdStage, prim: Any, index: int) -> None:
    """Let a joint begin where the file places its bodies, unless the file gives its position or its frames are elsewhere."""
    builder, path = both.builder, str(prim.GetPath())
    if any(STATE.match(attribute.GetName()) for attribute in prim.GetAuthoredAttributes()):
        return
    parent, child = builder.joint_parent[index], builder.joint_child[index]
    above = wp.transform(*builder.body_q[parent]) if parent >= 0 else wp.transform_identity()
    above = above * wp.transform(*builder.joint_X_p[index])
    pose = wp.transform(*builder.body_q[child])
    moved = wp.transform_inverse(above) * pose * wp.transform(*builder.joint_X_c[index])
    kind, column = builder.joint_type[index], builder.joint_q_start[index]
    is_single = sum(builder.joint_dof_dim[index]) == 1
    axis = wp.vec3(*builder.joint_axis[builder.joint_qd_start[index]]) if is_single else wp.vec3()
    held = wp.transform_identity()
    if kind == newton.JointType.REVOLUTE:
        angle = 2.0 * math.atan2(wp.dot(axis, wp.vec3(*[*moved.q][:3])), moved.q[3])
        angle = math.remainder(angle, 2.0 * math.pi)
        both.correct(f"joint {path}", "position", builder.joint_q, column, angle, within=PLACE)
        held = wp.transform(wp.vec3(), wp.quat_from_axis_angle(axis, angle))
    elif kind == newton.JointType.PRISMATIC:
        distance = wp.dot(axis, moved.p)
        both.correct(f"joint {path}", "position", builder.joint_q, column, distance, within=PLACE)
        held = wp.transform(axis * distance, wp.quat_identity())
    elif kind == newton.JointType.BALL:
        held = wp.transform(wp.vec3(), moved.q)
        builder.joint_q[column : column + 4] = [*moved.q]
    if not same_pose(moved, held):
        built = above * held * wp.transform_inverse(wp.transform(*builder.joint_X_c[index]))
        both.differ(f"body {builder.body_label[child]}", "place", built, pose)


def _compare_limits(both: UsdStage, prim: Any, dof: int, freedom: str) -> None:
    names = ("lowerLimit", "upperLimit") if freedom in ("angular", "linear") else ("low", "high")
    prefix = "physics:" if freedom in ("angular", "linear") else f"limit:{freedom}:physics:"
    shift = authored(prim, "mjc:ref") or 0.0
    for name, values in zip(names, (both.builder.joint_limit_lower, both.builder.joint_limit_upper), strict=True):
        limit = authored(prim, prefix + name)
        if limit is not None and not shift:
            in_file = float(limit) * (DEGREE if freedom in ANGULAR else 1.0)
            both.correct(f"joint {prim.GetPath()}", prefix + name, values, dof, in_file)


def _compare_numbers(both: UsdStage, prim: Any, dof: int, freedom: str) -> None:
    element, angle = f"joint {prim.GetPath()}", DEGREE if freedom in ANGULAR else 1.0
    for field, (word, *names) in NUMBERS.items():
        in_file = authored(prim, *names)
        if in_file is not None:
            both.correct(element, word, getattr(both.builder, field), dof, float(in_file))
    degrees, damping = authored(prim, "newton:damping"), authored(prim, "mjc:damping")
    if degrees is not None or damping is not None:
        in_file = float(degrees) / angle if degrees is not None else float(np.ravel(damping)[0])
        both.correct(element, "damping", both.builder.joint_damping, dof, in_file)


def _compare_drive(both: UsdStage, prim: Any, dof: int, freedom: str, actuator: int | None) -> None:
    """Compare a drive with the actuator that was made of it."""
    if not prim.HasAPI(UsdPhysics.DriveAPI, freedom):
        return
    drive, builder = UsdPhysics.DriveAPI(prim, freedom), both.builder
    element, angle = f"drive {prim.GetPath()}.{freedom}", DEGREE if freedom in ANGULAR else 1.0
    stiffness, damping = (attribute.Get() / angle for attribute in (drive.GetStiffnessAttr(), drive.GetDampingAttr()))
    if not stiffness and not damping:
        return
    if actuator is None:
        both.differ(element, "existence", "missing", "there")
        return
    if drive.GetTypeAttr().Get() != "force":
        both.differ(element, "type", "force", drive.GetTypeAttr().Get())
    bias = actuator_value(builder, "actuator_biasprm", actuator)
    for word, built, in_file in (("stiffness", -bias[1], stiffness), ("damping", -bias[2], damping)):
        if not same(built, in_file):
            both.differ(element, word, built, in_file)
    limit = drive.GetMaxForceAttr().Get()
    if limit is not None and math.isfinite(limit):
        limit = min(float(limit), builder.joint_effort_limit[dof])  # the joint may have a smaller one of its own
        both.correct(element, "maxForce", builder.joint_effort_limit, dof, limit)
    velocity = drive.GetTargetVelocityAttr().Get() or 0.0
    if stiffness and velocity:
        both.differ(element, "targetVelocity", 0.0, velocity * angle)
