"""Newton's MuJoCo solver with the constants that MuJoCo-Warp leaves out or finds otherwise than MuJoCo's compiler."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import mujoco
import newton
import numpy as np
import warp as wp
from newton.solvers import SolverMuJoCo

from worker.simulation.broadphase import for_any_number
from worker.simulation.mujoco_worlds import MujocoWorlds
from worker.simulation.robot_values import from_actuators

wp.set_module_options({"enable_backward": False})

SLIDERS = "muster:slider"
"""Custom attribute of the bodies that MuJoCo counts among its simple ones and that only slide (``body_simple`` is 2)."""
_LEAST = float(mujoco.mjMINVAL)
_NEXT_TO_NONE = wp.constant(1e-2)
"""Share of a body's other weight that stands for a weight of 0: float32 can't solve constraints that are not soft at all."""
_KEPT, _SLIDER, _STAYS, _KEEPS_ITS_TURN = (wp.constant(kind) for kind in (0, 1, 2, 3))
"""How a body's weights are found: as they are; of a slider; of one whose centre of mass, or whose orientation, can't move."""


def mark_sliders(builder: newton.ModelBuilder, bodies: Iterable[int]) -> None:
    """Mark the bodies of a builder that MuJoCo finds to be sliders, by their indices."""
    if marked := {body: True for body in bodies}:
        body = newton.Model.AttributeFrequency.BODY
        attribute = newton.ModelBuilder.CustomAttribute(
            name="slider", dtype=wp.bool, frequency=body, namespace="muster"
        )
        builder.add_custom_attribute(attribute)
        builder.custom_attributes[SLIDERS].values = marked


def is_slider(model: Any, body: int) -> bool:
    """Whether MuJoCo's compiler finds that a body only slides, along its own axes (``model`` is a ``mujoco.MjModel``)."""
    return bool(model.body_simple[body] == 2 and model.body_dofnum[body])


def weigh_sliders(model: Any, bodies: Sequence[int]) -> None:
    """Give sliders of a ``mujoco.MjModel`` MuJoCo's weights: the inverse of their mass, whatever their axes and armatures."""
    for body in bodies:
        model.body_invweight0[body] = 1.0 / model.body_mass[body], 0.0
        first = model.body_dofadr[body]
        model.dof_invweight0[first : first + model.body_dofnum[body]] = 1.0 / model.body_mass[body]


@wp.func
def amended_weights(kind: int, mass: float, weights: wp.vec2) -> wp.vec2:
    """Inverse weights of a body as MuJoCo's compiler finds them, of those of MuJoCo-Warp, which puts one in place of another that is 0."""
    if kind == _SLIDER:
        return wp.vec2(1.0 / mass, _NEXT_TO_NONE / mass)
    if kind == _STAYS and weights[0] == weights[1]:
        return wp.vec2(_NEXT_TO_NONE * weights[1], weights[1])
    if kind == _KEEPS_ITS_TURN and weights[0] == weights[1]:
        return wp.vec2(weights[0], _NEXT_TO_NONE * weights[0])
    return weights


@wp.func
def is_marked(kind: int) -> bool:
    """Whether a body of this kind is a slider."""
    return kind == _SLIDER


@wp.kernel
def _amend_weights(
    kinds: wp.array[wp.int32],
    first_dofs: wp.array[wp.int32],
    dof_counts: wp.array[wp.int32],
    masses: wp.array2d[wp.float32],
    body_weights: wp.array2d[wp.vec2],
    dof_weights: wp.array2d[wp.float32],
):
    world, body = wp.tid()
    mass = masses[world % masses.shape[0], body]
    body_weights[world, body] = amended_weights(kinds[body], mass, body_weights[world, body])
    if is_marked(kinds[body]):
        for dof in range(dof_counts[body]):
            dof_weights[world, first_dofs[body] + dof] = 1.0 / mass


@wp.kernel
def _add(added: wp.array[wp.float32], values: wp.array2d[wp.float32]):
    world, column = wp.tid()
    values[world, column] = values[world, column] + added[column]


class Solver(SolverMuJoCo):
    """Takes all substeps between one push of Newton's state to MuJoCo and one pull back: substeps don't need Newton's coordinates.

    An actuator's armature is part of that of its joint or tendon, times the square of its gear: MuJoCo-Warp knows no other. Inverse weights,
    by which constraints are soft, are MuJoCo's. Sources: MuJoCo's XML reference, actuator, ``armature``; its ``mj_setConst``.

    Args:
        model: Newton's model.
        options: Of ``SolverMuJoCo``.
    """

    # which Newton declares as optional: its constructor sets them
    mjc_body_to_newton: wp.array2d[wp.int32]
    mjc_dof_to_newton_dof: wp.array2d[wp.int32]
    mjc_geom_to_newton_shape: wp.array2d[wp.int32]
    substeps = 1
    before_substep: Sequence[Callable[[], None]] = ()
    after_substep: Sequence[Callable[[], None]] = ()
    _rotors: tuple[wp.array[wp.float32] | None, ...] | None = None
    _kinds: wp.array[wp.int32] | None = None

    def __init__(self, model: newton.Model, **options: Any) -> None:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message=".*does not support actuator armature")
            super().__init__(model, **options)

    @classmethod
    def import_mujoco(cls) -> tuple[Any, Any]:
        """MuJoCo and MuJoCo-Warp, as :class:`worker.simulation.mujoco_worlds.MujocoWorlds`."""
        find: Any = super().import_mujoco  # which has no types
        mujoco, mujoco_warp = find()
        return mujoco, MujocoWorlds(mujoco_warp)

    def _init_actuators(
        self, model: newton.Model, spec: Any, template_world: int, *arguments: Any, **named: Any
    ) -> int:
        """Newton looks for the actuators of one world among those of all, one by one; here those of later worlds are hidden."""
        counts, own = model.custom_frequency_counts, getattr(getattr(model, "mujoco", None), "actuator_world", None)
        if own is not None:
            seen = np.isin(own.numpy(), (template_world, -1)).nonzero()[0]
            model.custom_frequency_counts = counts | {"mujoco:actuator": int(seen.max(initial=-1)) + 1}
        try:
            added: int = super()._init_actuators(model, spec, template_world, *arguments, **named)
        finally:
            model.custom_frequency_counts = counts
        return added

    def _mujoco_warp_step(self) -> None:
        for _ in range(self.substeps):
            for launch in self.before_substep:
                launch()
            with for_any_number(self.model.world_count):
                super()._mujoco_warp_step()
            for launch in self.after_substep:
                launch()

    def _update_dof_armature(self, lock: bool = False) -> None:
        super()._update_dof_armature(lock)
        self._add_rotors(0, self.mjw_model.dof_armature)

    def _update_tendon_properties(self) -> None:
        update: Any = super()._update_tendon_properties  # which has no types
        update()
        self._add_rotors(1, self.mjw_model.tendon_armature)
        if self.use_mujoco_cpu and self.mj_model.ntendon:
            self.mj_model.tendon_armature[:] = self.mjw_model.tendon_armature.numpy()[0]

    def _add_rotors(self, kind: int, armatures: wp.array2d[wp.float32]) -> None:
        """Add the armatures of actuators to those of the joints' degrees of freedom (``kind`` 0) or the tendons (1)."""
        if self._rotors is None:
            model, device = self.mj_model, self.model.device
            found = from_actuators(model, "armature")
            model.dof_armature[:] += found[0]
            model.tendon_armature[:] += found[1]
            model.actuator_armature[:] = 0.0
            self._rotors = tuple(
                wp.array(each, dtype=wp.float32, device=device) if each.any() else None for each in found
            )
        if self._rotors[kind] is not None:
            wp.launch(_add, dim=armatures.shape, inputs=[self._rotors[kind], armatures], device=self.model.device)

    def _set_const_0(self, lock_kinematic: bool = True) -> None:
        super()._set_const_0(lock_kinematic)
        if self.use_mujoco_cpu:
            weigh_sliders(self.mj_model, self.sliders())
            return
        if self._kinds is None:
            self._kinds = wp.array(self.kinds(), dtype=wp.int32, device=self.model.device)
        model = self.mjw_model
        inputs = [self._kinds, model.body_dofadr, model.body_dofnum, model.body_mass]
        outputs = [model.body_invweight0, model.dof_invweight0]
        wp.launch(_amend_weights, dim=outputs[0].shape, inputs=inputs, outputs=outputs, device=self.model.device)

    def sliders(self) -> list[int]:
        """The marked bodies, by their indices in MuJoCo's model."""
        marks = getattr(getattr(self.model, "muster", None), "slider", None)
        if marks is None:
            return []
        bodies = self.mjc_body_to_newton.numpy()[0]
        return [body for body, index in enumerate(bodies) if index >= 0 and marks.numpy()[index]]

    def kinds(self) -> Any:
        """How the weights of each body are found, as :func:`amended_weights` takes it, shape ``(bodies,)``."""
        moves, turns = (self.mj_model.body_invweight0 > _LEAST).T
        kinds = np.where(turns & ~moves, _STAYS, _KEPT)
        if (self.mj_model.eq_type == int(mujoco.mjtEq.mjEQ_WELD)).any():  # nothing else reads weights of rotations
            kinds[moves & ~turns] = _KEEPS_ITS_TURN
        kinds[self.sliders()] = _SLIDER
        return kinds

    @staticmethod
    def _preserved_masks_cover_collision_filters(
        model: newton.Model, selected_shapes: Any, collision_type: Any, collision_affinity: Any, body_filters: Any
    ) -> bool:
        """Newton checks whether masks alone exclude all filtered pairs, and replaces the masks if they don't.

        In MuJoCo shapes fixed to the world never collide with the world, whatever their masks, so such pairs (the base of an arm and the
        ground) are not a reason to replace masks.
        """
        of_shapes = {int(body) for body in model.shape_body.numpy()[selected_shapes]}
        fixed = sorted(of_shapes & _fixed_bodies(model))
        filters = [*body_filters, *((first, second) for first in fixed for second in fixed)]
        return SolverMuJoCo._preserved_masks_cover_collision_filters(
            model, selected_shapes, collision_type, collision_affinity, filters
        )


def _fixed_bodies(model: newton.Model) -> set[int]:
    """Bodies of the first world, or of none, that are connected to the world only by fixed joints."""
    fixed = {-1}
    chosen = model.joint_world.numpy() <= 0
    columns = (each.numpy()[chosen].tolist() for each in (model.joint_type, model.joint_parent, model.joint_child))
    for kind, parent, child in zip(*columns, strict=True):  # parents come first
        if kind == newton.JointType.FIXED and parent in fixed:
            fixed.add(child)
    return fixed
