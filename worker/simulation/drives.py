"""The drives of a robot before each physics step: delays of its inputs, and motors whose force is computed explicitly."""

from __future__ import annotations

from typing import Any

import newton
import numpy as np
import torch
import warp as wp
from newton.actuators import Actuator, ClampingDCMotor, DrivePD
from newton.solvers import SolverMuJoCo

wp.set_module_options({"enable_backward": False})


@wp.kernel
def _deliver(
    controls: wp.array2d[wp.float32],
    delays: wp.array[wp.int32],
    computed: wp.array[wp.int32],
    history: wp.array3d[wp.float32],
    pushes: wp.array2d[wp.int32],
    targets: wp.array2d[wp.float32],
    inputs: wp.array2d[wp.float32],
):
    """Remember the input, and hand on the one of ``delays`` physics steps ago, or the oldest there is.

    A native actuator gets it as it is; an explicit one's force is added to the 0 left here. The history is a ring a world and actuator, so
    that it does not depend on what happens in other worlds.
    """
    world, actuator = wp.tid()
    depth = history.shape[2]
    row = world * controls.shape[1] + actuator
    count = pushes[world, actuator]
    history[world, actuator, count % depth] = controls[world, actuator]
    back = wp.min(wp.min(delays[row], depth - 1), count)
    value = history[world, actuator, (count - back) % depth]
    count += 1
    if count >= 2 * depth:
        count -= depth  # more than a full ring says nothing more, and the number must not run over
    pushes[world, actuator] = count
    if computed[row] != 0:
        targets[world, actuator] = value
        inputs[world, actuator] = 0.0
    else:
        inputs[world, actuator] = value


@wp.kernel
def _forget(ages: wp.array[wp.int32], pushes: wp.array2d[wp.int32]):
    """Inputs of the episode before are not obeyed in a new one."""
    world, actuator = wp.tid()
    if ages[world] == 0:
        pushes[world, actuator] = 0


class Drives:
    """The delays and explicit motors of many worlds, launched before each physics step.

    Forces come from ``newton.actuators``, which read MuJoCo's own coordinates, those of this physics step, and write the inputs of
    plain motors in MuJoCo. Delays are kept here: Newton's keeps one index for all worlds, so that worlds couldn't change places.
    Gains, limits and delays are read from ``model.muster``, one per world and actuator. Changes there take effect at the next step;
    delays may grow up to the longest declared one.

    Args:
        model: A model with the ``muster`` attributes of :mod:`worker.simulation.actuators`.
        solver: Of the model; all actuators take their inputs directly.
        world_count: Number of worlds.

    Attributes:
        controls: Inputs written by a task, shape ``(worlds, actuators)``.
    """

    def __init__(self, model: newton.Model, solver: SolverMuJoCo, world_count: int) -> None:
        own: Any = vars(model)["muster"]
        self._attributes, device = own, model.device
        data, compiled = solver.mjw_data, solver.mj_model
        shape = (world_count, compiled.nu)
        depth = 1 + int(own.delay.numpy().max())
        self._inputs = data.ctrl
        self.controls, self._targets = (wp.zeros(shape, dtype=wp.float32, device=device) for _ in range(2))
        self._history = wp.zeros((*shape, depth), dtype=wp.float32, device=device)
        self._pushes = wp.zeros(shape, dtype=wp.int32, device=device)
        explicit = own.explicit.numpy().reshape(shape)[0] != 0
        joints = np.where(explicit, compiled.actuator_trnid[:, 0], 0)

        def rows(columns: Any, width: int) -> wp.array[wp.uint32]:
            of_worlds = np.arange(world_count)[:, None] * width + columns
            return wp.array(of_worlds.ravel(), dtype=wp.uint32, device=device)

        # All actuators are in it, so that it reads the model's own arrays: a native one has no gains here and adds 0 to its input.
        self._actuator = Actuator(
            indices=rows(compiled.jnt_dofadr[joints], compiled.nv),
            pos_indices=rows(compiled.jnt_qposadr[joints], compiled.nq),
            target_pos_indices=rows(np.arange(compiled.nu), compiled.nu),
            effort_indices=rows(np.arange(compiled.nu), compiled.nu),
            drive=DrivePD(kp=own.stiffness, kd=own.damping),
            clamping=[ClampingDCMotor(own.saturation_effort, own.velocity_limit, own.effort_limit)],
            control_feedforward_attr=None,
        )
        self._has_motors = bool(explicit.any())
        self._state = {"joint_q": data.qpos.flatten(), "joint_qd": data.qvel.flatten()}
        self._control = {
            "joint_target_q": self._targets.flatten(),
            "joint_target_qd": wp.zeros(data.qvel.size, dtype=wp.float32, device=device),
            "joint_f": self._inputs.flatten(),
        }

    def launch(self) -> None:
        """Write MuJoCo's inputs for the next physics step."""
        own = self._attributes
        inputs = [self.controls, own.delay, own.explicit, self._history, self._pushes, self._targets, self._inputs]
        wp.launch(_deliver, dim=self.controls.shape, inputs=inputs, device=self.controls.device)
        if self._has_motors:
            self._actuator.step(self._state, self._control)

    def settle(self, ages: wp.array[wp.int32]) -> None:
        """Forget the inputs of worlds whose episode begins (``ages[world] == 0``)."""
        wp.launch(_forget, dim=self.controls.shape, inputs=[ages, self._pushes], device=self.controls.device)

    def forget(self) -> None:
        """Forget all inputs."""
        self._pushes.zero_()

    def state_tensors(self) -> dict[str, torch.Tensor]:
        """State kept between control steps: past inputs, shape ``(worlds, actuators, steps)``, and their number."""
        return {"inputs": wp.to_torch(self._history), "input_counts": wp.to_torch(self._pushes)}


def has_drives(model: newton.Model) -> bool:
    """Whether any actuator of a model has a delay or is computed explicitly."""
    attributes: Any = getattr(model, "muster", None)
    if attributes is None:
        return False
    return bool(attributes.explicit.numpy().any() or attributes.delay.numpy().any())
