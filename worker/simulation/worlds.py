"""N copies of one Newton model, one per world, stepped by MuJoCo-Warp."""

from __future__ import annotations

import inspect
import warnings
from collections.abc import Callable, Mapping
from typing import Any

import newton
import warp as wp
from newton.solvers import SolverMuJoCo

from shared_store.contract.error_text import nearest
from worker.simulation.collisions import share, share_ground
from worker.simulation.drives import Drives, has_drives
from worker.simulation.robot_elements import empty_builder, keep_inertias, unload
from worker.simulation.solver import Solver
from worker.simulation.structs import filled
from worker.simulation.terrain import Terrain
from worker.simulation.terrain_arrays import Ground
from worker.simulation.tiling import tiled

wp.set_module_options({"enable_backward": False})


@wp.struct
class WorldArrays:
    """State of the physics that a task's kernels read and write, one row per world.

    Attributes:
        joint_q: Joint coordinates [m, rad, quaternion xyzw], shape ``(worlds, coordinates)``.
        joint_qd: Joint velocities [m/s, rad/s], shape ``(worlds, dofs)``. A free joint holds the linear velocity of its
            body's centre of mass and then the angular velocity, both in the world frame.
        controls: Actuator inputs in the order of the model file [actuator's own unit], shape ``(worlds, actuators)``.
        drives: Forces of the actuators on the joints in the last physics step [N, N m], shape ``(worlds, dofs)``.
        warm_start: Accelerations [m/s^2, rad/s^2] from which the constraint solver starts, shape ``(worlds, dofs)``.
        activations: State of stateful actuators, such as filters and muscles, shape ``(worlds, activations)``.
        start_q: The model's own joint coordinates, as ``joint_q``.
        start_qd: The model's own joint velocities, as ``joint_qd``.
        overflow: Bits of ``mujoco_warp.OverflowType`` in the last :meth:`Worlds.simulate`, which clears them first, shape ``(worlds,)``.
        fastest: Velocity above which the physics counts as failed [m/s, rad/s].
    """

    joint_q: wp.array2d[wp.float32]
    joint_qd: wp.array2d[wp.float32]
    controls: wp.array2d[wp.float32]
    drives: wp.array2d[wp.float32]
    warm_start: wp.array2d[wp.float32]
    activations: wp.array2d[wp.float32]
    start_q: wp.array2d[wp.float32]
    start_qd: wp.array2d[wp.float32]
    overflow: wp.array[wp.int32]
    fastest: float


@wp.func
def is_sound(worlds: WorldArrays, world: int) -> bool:
    """Whether a world's physics can be believed: finite, and no velocity beyond ``worlds.fastest``.

    A contact on which the solver fails throws a robot through enormous velocities before anything is NaN, and one such step in
    millions is enough to spoil returns and the observations' moments for the rest of a training.
    """
    for column in range(worlds.joint_q.shape[1]):
        if not wp.isfinite(worlds.joint_q[world, column]):
            return False
    for column in range(worlds.joint_qd.shape[1]):  # noqa: SIM110 (Warp has no all())
        if not wp.abs(worlds.joint_qd[world, column]) < worlds.fastest:  # NaN is not either
            return False
    return True


@wp.func
def restore_start(worlds: WorldArrays, world: int):
    """Put every joint of a world where the model has it, with the model's own velocity (0 as a rule)."""
    for column in range(worlds.joint_q.shape[1]):
        worlds.joint_q[world, column] = worlds.start_q[world, column]
    for column in range(worlds.joint_qd.shape[1]):
        worlds.joint_qd[world, column] = worlds.start_qd[world, column]


FEW_ITERATIONS = 8
"""Up to this many solver iterations are recorded one after the other, not as a loop that ends when all worlds are done."""

_SET_HERE: Mapping[str, Any] = {"disable_sensors": True, "kinematic_switchable_roots": False, "separate_worlds": True}
"""Solver options that a task can't set: neither MuJoCo's sensors nor kinematic roots are used, and both cost time in every step."""


class Worlds:
    """Identical, independent worlds that step together.

    Args:
        template: Builder holding one world. ``SolverMuJoCo.register_custom_attributes`` was called on it before import.
        world_count: Number of copies.
        device: ``"cpu"`` or ``"cuda:<n>"``.
        timestep: Length of one physics step [s].
        substeps: Physics steps of one :meth:`simulate`.
        fastest: See :class:`WorldArrays`.
        ground: Whether to add one ground plane (z = 0) that all worlds share, or the terrain that is their ground.
        solver_options: Keyword arguments of ``SolverMuJoCo`` (``njmax`` and ``nconmax`` are per world).

    Attributes:
        ground: The terrain on the device and the patch of every world; None without a terrain.
        drives: The delays and explicit motors of the actuators; None without either. A task calls ``drives.settle`` after resets and
            saves ``drives.state_tensors``.
        after_substep: Called after each physics step of :meth:`simulate`, in this order: launches only. The contacts and forces of that
            step are in ``solver.mjw_data``; Newton's own state (``arrays.joint_q``, ``state``) is still that before :meth:`simulate`.
        pushed: Bodies of a world with external forces, ``state.body_f``, which the solver reads.

    Raises:
        ValueError: A solver option is unknown or reserved, the robot has actuators that would ignore the controls, or the terrain would
            not fit into memory.
    """

    def __init__(
        self,
        template: newton.ModelBuilder,
        world_count: int,
        device: str,
        *,
        timestep: float,
        substeps: int,
        fastest: float,
        ground: bool | Terrain = False,
        solver_options: Mapping[str, Any],
    ) -> None:
        _check_options(solver_options)
        has_masks = share(template)
        if isinstance(ground, Terrain):
            ground.check_memory(device)

        def scene(count: int) -> newton.ModelBuilder:
            builder = empty_builder()
            keep_inertias(builder)
            builder.replicate(template, count)
            if isinstance(ground, Terrain):
                ground.add_to(builder)
            elif ground:
                builder.add_ground_plane()
            if has_masks:
                share_ground(builder)
            # Newton gives a shape whose file says nothing a gap of 0.1 m, in which contacts are found, stored and not used; MuJoCo gives
            # none. Without it there are 3 to 4 times fewer of them on a robot that stands.
            builder.shape_gap = [0.0 if gap == builder.rigid_gap else gap for gap in builder.shape_gap]
            return builder

        self.ground = Ground(ground, world_count, device) if isinstance(ground, Terrain) else None
        with warnings.catch_warnings():
            # of height fields that can't collide with each other; those of a terrain don't
            warnings.filterwarnings("ignore", message="Heightfield-vs-heightfield")
            self.model = tiled(scene, world_count, device)
        self.solver = Solver(self.model, **_SET_HERE, **solver_options)
        unload(self.model, self.solver)
        self.solver.substeps = substeps
        self.after_substep: list[Callable[[], None]] = []
        self.pushed: set[int] = set()
        self.solver.after_substep = self.after_substep
        # The kernels would print each overflow, which is slow; it is counted instead (see WorldArrays.overflow).
        options = self.solver.mjw_model.opt
        options.warn_overflow = 0
        # A graph's loop asks the device after every iteration whether to go on, which costs more than the few iterations of a
        # solver that was given a small limit: most of thousands of worlds need them all.
        if device.startswith("cuda") and options.iterations <= FEW_ITERATIONS:
            options.graph_conditional = False
        # half the solver's own choice: 2 % of Humanoid's simulation on an H200, 1.5 % of Ant's
        self.solver.mjw_model.block_dim.update_gradient_cholesky = 32
        self.state = self.model.state()
        self.control = self.model.control()
        _check_controls(self.model, self.solver, self.control)
        self.world_count = world_count
        self.timestep = timestep
        self.substeps = substeps

        def rows(array: Any) -> Any:
            return array.reshape((world_count, -1))

        self.drives = Drives(self.model, self.solver, world_count) if has_drives(self.model) else None
        if self.drives is not None:
            self.solver.before_substep = [self.drives.launch]
        data = self.solver.mjw_data
        self.arrays: WorldArrays = filled(
            WorldArrays,
            device,
            joint_q=rows(self.state.joint_q),
            joint_qd=rows(self.state.joint_qd),
            controls=self.drives.controls if self.drives else rows(vars(self.control)["mujoco"].ctrl),
            drives=data.qfrc_actuator,
            warm_start=data.qacc_warmstart,
            activations=data.act,
            start_q=rows(self.model.joint_q),
            start_qd=rows(self.model.joint_qd),
            overflow=data.overflow,
            fastest=fastest,
        )

    def simulate(self) -> None:
        """Advance all worlds by ``substeps`` physics steps; launches only, so that it can be captured.

        This updates joint coordinates but not body poses (:meth:`update_bodies`), which cost 2 to 3 % of a training and which tasks that
        read only joints don't need.
        """
        # the solver ends each step with the kinematics of all articulations: here there are none
        count, self.model.articulation_count = self.model.articulation_count, 0
        try:
            self.solver.step(self.state, self.state, self.control, None, self.timestep)
        finally:
            self.model.articulation_count = count

    def restore_defaults(self) -> None:
        """Put every world in the model's own pose, at rest, with a cold solver."""
        self.state.joint_q.assign(self.model.joint_q)
        self.state.joint_qd.assign(self.model.joint_qd)
        self.arrays.controls.zero_()
        if self.drives is not None:
            self.drives.forget()
        self.arrays.warm_start.zero_()
        self.arrays.activations.zero_()
        self.arrays.overflow.zero_()

    def update_bodies(self) -> None:
        """Compute body poses and velocities (``state.body_q``, ``state.body_qd``) from joint coordinates."""
        newton.eval_fk(self.model, self.state.joint_q, self.state.joint_qd, self.state)

    def update_shapes(self) -> None:
        """Move the shapes that cameras see to the poses computed by :meth:`update_bodies`."""
        self.model.bvh_refit_shapes(self.state)


def _check_options(options: Mapping[str, Any]) -> None:
    known = [name for name in inspect.signature(SolverMuJoCo).parameters if name != "model"]
    for name in options:
        if name in _SET_HERE:
            raise ValueError(f"solver_options: {name} is always {_SET_HERE[name]} here; leave it out")
        if name not in known:
            raise ValueError(f"solver_options: SolverMuJoCo has no option {name!r}; {nearest(name, known)}")


def _check_controls(model: newton.Model, solver: SolverMuJoCo, control: newton.Control) -> None:
    """Refuse actuators that would ignore ``worlds.controls``: the robot would hold its pose, whatever the policy does."""
    controls = getattr(getattr(control, "mujoco", None), "ctrl", None)
    sources = solver.mjc_actuator_ctrl_source
    direct = int(SolverMuJoCo.CtrlSource.CTRL_DIRECT)
    if controls is None or not controls.size:
        if sources is None:
            raise ValueError(
                "the robot has no actuators, so no action could move it; give worker.simulation.robot.Robot its actuators, or its MJCF "
                "file an <actuator> section"
            )
        joints = model.joint_target_mode.numpy()[: solver.mj_model.nv].nonzero()[0]
        raise ValueError(
            f"nothing would drive the robot: {_joints(model, joints)} follow joint targets, as joints of URDF and USD files do, and a "
            "task only writes inputs of actuators; give worker.simulation.robot.Robot its actuators, or describe the robot in MJCF, "
            "with an <actuator> section, and add it with builder.add_mjcf(file, ctrl_direct=True)"
        )
    attributes: Any = vars(model)["mujoco"]
    count = controls.size // max(1, model.world_count)
    unread = (attributes.ctrl_source.numpy()[:count] != direct).nonzero()[0]
    if unread.size:
        joints = attributes.actuator_trnid.numpy()[unread, 0]
        raise ValueError(
            f"the <position> and <velocity> actuators of {_joints(model, joints)} would ignore a task's controls, since they follow joint "
            "targets; add the robot with builder.add_mjcf(file, ctrl_direct=True), which makes their controls their targets"
        )


def _joints(model: newton.Model, dofs: Any) -> str:
    """The names of the joints that have these degrees of freedom."""
    starts = model.joint_qd_start.numpy()
    names = [model.joint_label[int(starts.searchsorted(dof, side="right")) - 1].rpartition("/")[2] for dof in dofs]
    return f"joint{'s' if len(names) != 1 else ''} {', '.join(names)}"
