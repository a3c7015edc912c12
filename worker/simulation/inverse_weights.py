"""Inverse weights and other constants that MuJoCo derives from masses and armatures, recomputed for selected worlds.

MuJoCo scales the softness of contacts, joint limits and dry friction by ``dof_invweight0`` and ``body_invweight0``: mean diagonals of
``J M^-1 J^T`` in the model's reference pose. mujoco_warp's ``set_const`` finds them with a solve of the whole mass matrix for each
degree of freedom and six for each body, in all worlds: about 700 launches for a humanoid of 29 joints. Here one thread a world goes
through the tree twice, as in the articulated-body algorithm (R. Featherstone, *Rigid Body Dynamics Algorithms*, 2008, ch. 7), and only
worlds whose bodies changed do: two launches, whose cost grows with the number of such worlds.

The pose is the same in all worlds, so joint axes and body frames are constants.
"""

from __future__ import annotations

from typing import Any

import mujoco
import newton
import numpy as np
import warp as wp

from worker.simulation.solver import Solver, amended_weights, is_marked
from worker.simulation.structs import filled
from worker.simulation.worlds import Worlds

wp.set_module_options({"enable_backward": False})

_LEAST = wp.constant(float(mujoco.mjMINVAL))


@wp.struct
class Tree:
    """The bodies of a world in the reference pose, relative to the frame of the first body of their tree.

    Attributes:
        parents: Parent of each body, shape ``(bodies,)``.
        first_dofs: First degree of freedom of each body, shape ``(bodies,)``.
        dof_counts: Degrees of freedom of each body, shape ``(bodies,)``.
        welded: Whether a body is welded to the world, shape ``(bodies,)``.
        kinds: How the weights of each body are found (:meth:`worker.simulation.solver.Solver.kinds`), shape ``(bodies,)``.
        positions: Of the bodies' frames [m], shape ``(bodies,)``.
        rotations: Of the bodies' frames, shape ``(bodies,)``.
        axes: Angular and then linear velocity for each unit of joint velocity, shape ``(dofs,)``.
        group_firsts: First degree of freedom of those over which a weight is averaged, shape ``(dofs,)``.
        group_counts: How many these are, shape ``(dofs,)``.
    """

    parents: wp.array[wp.int32]
    first_dofs: wp.array[wp.int32]
    dof_counts: wp.array[wp.int32]
    welded: wp.array[wp.bool]
    kinds: wp.array[wp.int32]
    positions: wp.array[wp.vec3]
    rotations: wp.array[wp.quat]
    axes: wp.array[wp.spatial_vectorf]
    group_firsts: wp.array[wp.int32]
    group_counts: wp.array[wp.int32]


@wp.struct
class Inertials:
    """The inertial fields of mujoco_warp's model and the constants derived from them, each with leading dimension worlds."""

    masses: wp.array2d[wp.float32]
    centers: wp.array2d[wp.vec3]
    frames: wp.array2d[wp.quat]
    moments: wp.array2d[wp.vec3]
    armatures: wp.array2d[wp.float32]
    subtree_masses: wp.array2d[wp.float32]
    body_weights: wp.array2d[wp.vec2]
    dof_weights: wp.array2d[wp.float32]


@wp.struct
class Scratch:
    """Scratch memory for one pass through the tree, leading dimension worlds."""

    matrices: wp.array2d[wp.spatial_matrixf]
    forces: wp.array2d[wp.spatial_vectorf]
    diagonal: wp.array2d[wp.float32]


@wp.func
def _from_wxyz(rotation: wp.quat) -> wp.quat:
    """mujoco_warp keeps quaternions with the real part first."""
    return wp.quat(rotation[1], rotation[2], rotation[3], rotation[0])


@wp.func
def _spatial_inertia(tree: Tree, inertials: Inertials, world: int, body: int) -> wp.spatial_matrix:
    """Of one body, angular part first, about the origin of its tree."""
    mass = inertials.masses[world, body]
    rotation = tree.rotations[body]
    center = tree.positions[body] + wp.quat_rotate(rotation, inertials.centers[world, body])
    turn = wp.quat_to_matrix(wp.mul(rotation, _from_wxyz(inertials.frames[world, body])))
    cross = wp.skew(center)
    angular = turn * wp.diag(inertials.moments[world, body]) * wp.transpose(turn) - mass * cross * cross
    result = wp.spatial_matrix()
    for row in range(3):
        for column in range(3):
            result[row, column] = angular[row, column]
            result[row, column + 3] = mass * cross[row, column]
            result[row + 3, column] = -mass * cross[row, column]
        result[row + 3, row + 3] = mass
    return result


@wp.func
def _weight_of_body(tree: Tree, inertials: Inertials, world: int, body: int, answer: wp.spatial_matrix) -> wp.vec2:
    """Mean acceleration of a body's centre of mass and of its rotation for a unit force and a unit torque on it, in all directions."""
    center = tree.positions[body] + wp.quat_rotate(tree.rotations[body], inertials.centers[world, body])
    angular, both, linear = wp.mat33(), wp.mat33(), wp.mat33()
    for row in range(3):
        for column in range(3):
            angular[row, column] = answer[row, column]
            both[row, column] = answer[row, column + 3]
            linear[row, column] = answer[row + 3, column + 3]
    lever = -wp.skew(center)
    moving = linear + lever * both + wp.transpose(lever * both) + lever * angular * wp.transpose(lever)
    translation = wp.trace(moving) / 3.0
    rotation = wp.trace(angular) / 3.0
    if translation < _LEAST and rotation > _LEAST:
        translation = rotation
    elif rotation < _LEAST and translation > _LEAST:
        rotation = translation
    return wp.vec2(translation, rotation)


@wp.kernel
def _weigh(changed: wp.array[wp.bool], tree: Tree, scratch: Scratch, inertials: Inertials):
    """Masses of subtrees and inverse weights of one world.

    From the leaves to the root: inertia of each articulated body and, joint by joint, what is left of it when the joint gives way. From
    the root to the leaves: how each body answers to a force on it.
    """
    world = wp.tid()
    if not changed[world]:
        return
    bodies = tree.parents.shape[0]
    for body in range(bodies):
        inertials.subtree_masses[world, body] = inertials.masses[world, body]
        scratch.matrices[world, body] = _spatial_inertia(tree, inertials, world, body)
    for back in range(bodies - 1):
        body = bodies - 1 - back
        parent = tree.parents[body]
        inertials.subtree_masses[world, parent] = (
            inertials.subtree_masses[world, parent] + inertials.subtree_masses[world, body]
        )
        inertia = scratch.matrices[world, body]
        for earlier in range(tree.dof_counts[body]):
            dof = tree.first_dofs[body] + tree.dof_counts[body] - 1 - earlier
            force = inertia * tree.axes[dof]
            diagonal = wp.dot(tree.axes[dof], force) + inertials.armatures[world, dof]
            inertia = inertia - wp.outer(force, force) / diagonal
            scratch.forces[world, dof] = force
            scratch.diagonal[world, dof] = diagonal
        # bodies of different trees have different origins, but nothing depends on the inertia of the world
        scratch.matrices[world, parent] = scratch.matrices[world, parent] + inertia

    scratch.matrices[world, 0] = wp.spatial_matrix()
    inertials.body_weights[world, 0] = wp.vec2(0.0, 0.0)
    for index in range(bodies - 1):
        body = index + 1
        answer = scratch.matrices[world, tree.parents[body]]
        for later in range(tree.dof_counts[body]):
            dof = tree.first_dofs[body] + later
            diagonal = scratch.diagonal[world, dof]
            push = answer * scratch.forces[world, dof] / diagonal
            weight = 1.0 / diagonal + wp.dot(scratch.forces[world, dof], push) / diagonal
            axis = tree.axes[dof]
            answer = answer - wp.outer(axis, push) - wp.outer(push, axis) + weight * wp.outer(axis, axis)
            scratch.diagonal[world, dof] = weight
        scratch.matrices[world, body] = answer
        weights = wp.vec2(0.0, 0.0)
        if not tree.welded[body]:
            weights = _weight_of_body(tree, inertials, world, body, answer)
            weights = amended_weights(tree.kinds[body], inertials.masses[world, body], weights)
        if is_marked(tree.kinds[body]):
            for own in range(tree.dof_counts[body]):
                scratch.diagonal[world, tree.first_dofs[body] + own] = weights[0]
        inertials.body_weights[world, body] = weights
    for dof in range(tree.axes.shape[0]):
        total = float(0.0)
        for member in range(tree.group_counts[dof]):
            total = total + scratch.diagonal[world, tree.group_firsts[dof] + member]
        inertials.dof_weights[world, dof] = total / float(tree.group_counts[dof])


class InverseWeights:
    """Keeps constants derived from masses and armatures up to date.

    Models with tendons or muscles need further constants. For them Newton recomputes everything in all worlds, with about three launches
    per degree of freedom and eighteen per body.

    Args:
        worlds: The worlds, whose model is changed in place. Construct this before a capture.

    Attributes:
        whole: Whether Newton recomputes everything.
    """

    def __init__(self, worlds: Worlds) -> None:
        self._worlds = worlds
        model, solver = worlds.solver.mj_model, worlds.solver
        muscles = (model.actuator_gaintype == mujoco.mjtGain.mjGAIN_MUSCLE).any()
        # Newton treats a kinematic root as locked
        self.whole = bool(model.ntendon or muscles or getattr(solver, "_kinematic_weld_eq", None) is not None)
        if self.whole:
            return
        device, count = worlds.model.device, worlds.world_count
        self._tree = _tree(model, solver, device)
        self._scratch = filled(
            Scratch,
            device,
            (count, model.nv),
            matrices=wp.zeros((count, model.nbody), dtype=wp.spatial_matrixf, device=device),
        )
        self._inertials = inertials_of(solver)

    def update(self, changed: wp.array[wp.bool]) -> None:
        """Launches that bring the worlds with ``changed`` (shape ``(worlds,)``, bool) up to date; they can be captured."""
        solver: Any = self._worlds.solver
        if self.whole:
            solver.notify_model_changed(newton.ModelFlags.BODY_INERTIAL_PROPERTIES)
            return
        inputs = [changed, self._tree, self._scratch]
        device = self._worlds.model.device
        wp.launch(_weigh, dim=self._worlds.world_count, inputs=inputs, outputs=[self._inertials], device=device)
        # Limits of joints that are given as a stiffness, as in URDF and USD files, are scaled by the weight of the joint.
        solver._update_solref_from_invweight0()


def inertials_of(solver: Solver) -> Any:
    """The :class:`Inertials` of a solver: views of its own arrays."""
    names = ("mass", "ipos", "iquat", "inertia", "subtreemass", "invweight0")
    bodies = [getattr(solver.mjw_model, f"body_{name}") for name in names]
    fields = ("masses", "centers", "frames", "moments", "subtree_masses", "body_weights")
    own = dict(zip(fields, bodies, strict=True))
    model = solver.mjw_model
    return filled(Inertials, None, armatures=model.dof_armature, dof_weights=model.dof_invweight0, **own)


def _tree(model: mujoco.MjModel, solver: Solver, device: wp.Device) -> Any:
    """The :class:`Tree` of a solver, from MuJoCo's own kinematics in the reference pose."""
    data = mujoco.MjData(model)
    data.qpos[:] = solver.mjw_model.qpos0.numpy()[0]
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    origins = data.xpos[model.body_rootid]
    roots = model.body_rootid[model.dof_bodyid]
    angular = data.cdof[:, :3]
    linear = data.cdof[:, 3:] + np.cross(angular, data.xpos[roots] - data.subtree_com[roots])
    firsts, counts = np.arange(model.nv), np.ones(model.nv, int)
    for joint in range(model.njnt):
        kind, first = model.jnt_type[joint], model.jnt_dofadr[joint]
        starts = (0, 3) if kind == mujoco.mjtJoint.mjJNT_FREE else (0,) if kind == mujoco.mjtJoint.mjJNT_BALL else ()
        for start in starts:
            firsts[first + start : first + start + 3] = first + start
            counts[first + start : first + start + 3] = 3
    return filled(
        Tree,
        device,
        parents=model.body_parentid,
        first_dofs=model.body_dofadr,
        dof_counts=model.body_dofnum,
        welded=model.body_weldid == 0,
        kinds=solver.kinds(),
        positions=data.xpos - origins,
        rotations=np.roll(data.xquat, -1, axis=1),
        axes=np.hstack([angular, linear]),
        group_firsts=firsts,
        group_counts=counts,
    )
