"""Kernels for the equations of differential inverse kinematics: Jacobian, normal equations and their solution, on the device."""

from __future__ import annotations

import warp as wp

from worker.simulation.episodes import EpisodeArrays
from worker.simulation.kinematics import root_pose
from worker.simulation.robot_arrays import BodyArrays, RobotArrays
from worker.simulation.sensors.sensor import place_pose
from worker.simulation.worlds import WorldArrays

wp.set_module_options({"enable_backward": False})


@wp.struct
class IkArrays:
    """Wanted motion of a frame in the coming control step, one row per world.

    Attributes:
        target: Displacement along and turn about the axes [m, rad]; where the declaration is ``absolute``, position and orientation
            [m, quaternion xyzw of any length]. Shape ``(worlds, columns)``; a column for each of the declared ``axes``. The joints'
            targets are computed from it after all actions are written; then it is reset to 0.
    """

    target: wp.array2d[wp.float32]


@wp.struct
class Chain:
    """The joints, the frame that they move, and scratch memory for the equations. The world is the last dimension, for coalesced access.

    Attributes:
        body, pose: Column of the frame's body, and the frame in it [m, quaternion xyzw].
        in_world: Whether the axes are those of the world, not of the root.
        absolute: Whether positions and orientations are wanted, not displacements.
        turn: First column of the wanted quaternion, -1 where there is none.
        rows: Index of each equation in ``AXES``, shape ``(equations,)``.
        columns: Column of ``IkArrays.target`` for each equation, shape ``(equations,)``; unused for a quaternion.
        weights: Squared weight of each equation, shape ``(equations,)``.
        children: Columns of the bodies that the joints move, shape ``(joints,)``.
        slides: 1 for sliding joints, 0 for hinges, shape ``(joints,)``.
        anchors, axes: Of the joints, in the frames of these bodies [m], shape ``(joints,)``.
        joints: Indices of the joints in ``RobotArrays``, shape ``(joints,)``.
        ranges: Least and greatest target of each joint [m, rad], shape ``(joints,)``.
        damping, posture, limits: Squares of these weights.
        max_step: Greatest distance of a joint's target from the joint's position [m, rad].
        errors: Displacement that each equation asks for [m, rad], shape ``(equations, worlds)``.
        jacobian: Motion along and about the axes per unit of each joint, shape ``(equations, joints, worlds)``.
        matrix: Matrix of the normal equations, then its Cholesky factor, shape ``(joints, joints, worlds)``; only the lower triangle is
            used.
        steps: Right-hand side, then the joints' displacements [m, rad], shape ``(joints, worlds)``.
        goes_on: Whether a step starts at the last targets.
        targets: The last targets [m, rad], shape ``(worlds, joints)``.
    """

    body: int
    pose: wp.transform
    in_world: bool
    absolute: bool
    turn: int
    rows: wp.array[wp.int32]
    columns: wp.array[wp.int32]
    weights: wp.array[wp.float32]
    children: wp.array[wp.int32]
    slides: wp.array[wp.int32]
    anchors: wp.array[wp.vec3]
    axes: wp.array[wp.vec3]
    joints: wp.array[wp.int32]
    ranges: wp.array[wp.vec2]
    damping: float
    posture: float
    limits: float
    max_step: float
    errors: wp.array2d[wp.float32]
    jacobian: wp.array3d[wp.float32]
    matrix: wp.array3d[wp.float32]
    steps: wp.array2d[wp.float32]
    goes_on: bool
    targets: wp.array2d[wp.float32]


@wp.func
def _movement(chain: Chain, bodies: BodyArrays, world: int, joint: int, position: wp.vec3):
    """Linear and angular movement of what is at ``position``, in the world frame, for one unit of a joint."""
    pose = bodies.poses[world, chain.children[joint]]
    axis = wp.transform_vector(pose, chain.axes[joint])
    linear = axis
    angular = wp.vec3(0.0, 0.0, 0.0)
    if chain.slides[joint] == 0:
        linear = wp.cross(axis, position - wp.transform_point(pose, chain.anchors[joint]))
        angular = axis
    return linear, angular


@wp.func
def _turn_to(here: wp.quat, target: wp.quat) -> wp.vec3:
    """Rotation vector, the shorter way, from one orientation to another [rad]; none where ``target`` has no length."""
    if wp.length(target) < 1.0e-6:
        return wp.vec3(0.0, 0.0, 0.0)
    between = wp.normalize(target) * wp.quat_inverse(here)
    if between[3] < 0.0:
        between = -between
    imaginary = wp.vec3(between[0], between[1], between[2])
    sine = wp.length(imaginary)
    if sine < 1.0e-6:
        return 2.0 * imaginary
    return (2.0 * wp.atan2(sine, between[3]) / sine) * imaginary


@wp.func
def _fill_errors(chain: Chain, ik: IkArrays, world: int, base: wp.transform, frame: wp.transform):
    here = wp.transform_multiply(wp.transform_inverse(base), frame)
    turn = wp.vec3(0.0, 0.0, 0.0)
    if chain.turn >= 0:
        target = wp.quat(
            ik.target[world, chain.turn],
            ik.target[world, chain.turn + 1],
            ik.target[world, chain.turn + 2],
            ik.target[world, chain.turn + 3],
        )
        turn = _turn_to(wp.transform_get_rotation(here), target)
    for equation in range(chain.rows.shape[0]):
        row = chain.rows[equation]
        if chain.absolute and row >= 3:
            chain.errors[equation, world] = turn[row - 3]
        else:
            error = ik.target[world, chain.columns[equation]]
            if chain.absolute:
                error -= wp.transform_get_translation(here)[row]
            chain.errors[equation, world] = error


@wp.func
def _fill_jacobian(chain: Chain, bodies: BodyArrays, world: int, root: wp.quat, position: wp.vec3):
    for joint in range(chain.joints.shape[0]):
        linear, angular = _movement(chain, bodies, world, joint, position)
        linear = wp.quat_rotate_inv(root, linear)
        angular = wp.quat_rotate_inv(root, angular)
        for column in range(chain.rows.shape[0]):
            row = chain.rows[column]
            if row < 3:
                chain.jacobian[column, joint, world] = linear[row]
            else:
                chain.jacobian[column, joint, world] = angular[row - 3]


@wp.func
def _fill_equations(chain: Chain, worlds: WorldArrays, robot: RobotArrays, world: int):
    """(J^T W J + D) dq = J^T W dx + r: D and r are of damping, posture and exceeded limits."""
    for first in range(chain.joints.shape[0]):
        joint = chain.joints[first]
        place = worlds.joint_q[world, robot.coordinates[joint]]
        ends = chain.ranges[first]
        excess = wp.clamp(place, ends[0], ends[1]) - place
        right = chain.posture * (robot.defaults[joint] - place) + chain.limits * excess
        for column in range(chain.rows.shape[0]):
            right += chain.weights[column] * chain.jacobian[column, first, world] * chain.errors[column, world]
        chain.steps[first, world] = right
        for second in range(first + 1):
            total = float(0.0)
            for column in range(chain.rows.shape[0]):
                moves = chain.jacobian[column, first, world] * chain.jacobian[column, second, world]
                total += chain.weights[column] * moves
            if first == second:
                total += chain.damping + chain.posture
                if excess != 0.0:
                    total += chain.limits
            chain.matrix[first, second, world] = total


@wp.func
def _solve_equations(chain: Chain, world: int):
    """Cholesky's factor in place of the matrix, then the solution in place of the right side."""
    count = chain.joints.shape[0]
    for row in range(count):
        for column in range(row + 1):
            total = chain.matrix[row, column, world]
            for each in range(column):
                total -= chain.matrix[row, each, world] * chain.matrix[column, each, world]
            if row == column:
                # without rounding it is never less than the damping
                chain.matrix[row, row, world] = wp.sqrt(wp.max(total, chain.damping))
            else:
                chain.matrix[row, column, world] = total / chain.matrix[column, column, world]
    for row in range(count):
        total = chain.steps[row, world]
        for each in range(row):
            total -= chain.matrix[row, each, world] * chain.steps[each, world]
        chain.steps[row, world] = total / chain.matrix[row, row, world]
    for back in range(count):
        row = count - 1 - back
        total = chain.steps[row, world]
        for each in range(row + 1, count):
            total -= chain.matrix[each, row, world] * chain.steps[each, world]
        chain.steps[row, world] = total / chain.matrix[row, row, world]


@wp.kernel
def move_frame(worlds: WorldArrays, bodies: BodyArrays, robot: RobotArrays, chain: Chain, ik: IkArrays):
    """Position targets of the joints of one world."""
    world = wp.tid()
    base = wp.transform_identity()
    if not chain.in_world:
        base = root_pose(worlds, robot, world)
    frame = place_pose(bodies, world, chain.body, chain.pose)
    _fill_errors(chain, ik, world, base, frame)
    _fill_jacobian(chain, bodies, world, wp.transform_get_rotation(base), wp.transform_get_translation(frame))
    _fill_equations(chain, worlds, robot, world)
    _solve_equations(chain, world)
    for index in range(chain.joints.shape[0]):
        joint = chain.joints[index]
        place = worlds.joint_q[world, robot.coordinates[joint]]
        target = place + chain.steps[index, world]
        if chain.goes_on:
            target = chain.targets[world, index] + chain.steps[index, world]
        ends = chain.ranges[index]
        target = wp.clamp(wp.clamp(target, place - chain.max_step, place + chain.max_step), ends[0], ends[1])
        chain.targets[world, index] = target
        worlds.controls[world, robot.actuators[joint]] = target + robot.references[joint]
    for column in range(ik.target.shape[1]):
        ik.target[world, column] = 0.0


@wp.kernel
def begin_targets(worlds: WorldArrays, episodes: EpisodeArrays, robot: RobotArrays, chain: Chain):
    """In a world that was placed afresh the last targets are where the joints are."""
    world = wp.tid()
    if episodes.ages[world] == 0:
        for index in range(chain.joints.shape[0]):
            chain.targets[world, index] = worlds.joint_q[world, robot.coordinates[chain.joints[index]]]
