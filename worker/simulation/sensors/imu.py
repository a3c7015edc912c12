"""An IMU (inertial measurement unit): gyro, accelerometer and velocimeter on a body."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import warp as wp

from worker.simulation.robot_arrays import BodyArrays
from worker.simulation.sensors.sensor import (
    BodyFrame,
    Sensor,
    SensorContext,
    SensorDeclaration,
    place_pose,
    place_velocity,
)
from worker.simulation.structs import filled

wp.set_module_options({"enable_backward": False})


@wp.struct
class ImuArrays:
    """Latest measurements of an inertial measurement unit, one row per world, in its own frame.

    Attributes:
        gyro: Angular velocity [rad/s], shape ``(worlds,)``.
        accelerometer: Acceleration minus gravity in the last physics step [m/s^2], shape ``(worlds,)``; at rest it points up. A world
            that was just reset counts as at rest until its first step.
        velocimeter: Linear velocity [m/s], shape ``(worlds,)``.
        rotations: From its frame to the world's [quaternion xyzw], shape ``(worlds,)``.
    """

    gyro: wp.array[wp.vec3]
    accelerometer: wp.array[wp.vec3]
    velocimeter: wp.array[wp.vec3]
    rotations: wp.array[wp.quat]


@wp.func
def projected_gravity(imu: ImuArrays, world: int) -> wp.vec3:
    """The direction of down in the frame of the unit, of length 1."""
    return wp.quat_rotate_inv(imu.rotations[world], wp.vec3(0.0, 0.0, -1.0))


@wp.struct
class _Dynamics:
    """The solver's kinematic tree and the motion of one physics step, named as in ``mujoco_warp.Model`` and ``Data``."""

    timestep: float
    gravity: wp.array[wp.vec3]
    body_parentid: wp.array[wp.int32]
    body_rootid: wp.array[wp.int32]
    body_jntnum: wp.array[wp.int32]
    body_dofnum: wp.array[wp.int32]
    body_dofadr: wp.array[wp.int32]
    xpos: wp.array2d[wp.vec3]
    xmat: wp.array2d[wp.mat33]
    subtree_com: wp.array2d[wp.vec3]
    cvel: wp.array2d[wp.spatial_vectorf]
    cdof: wp.array2d[wp.spatial_vectorf]
    cdof_dot: wp.array2d[wp.spatial_vectorf]
    qvel: wp.array2d[wp.float32]
    qacc: wp.array2d[wp.float32]


@wp.func
def _gravity(dynamics: _Dynamics, world: int) -> wp.vec3:
    return dynamics.gravity[world % dynamics.gravity.shape[0]]


@wp.func
def _motion_cross(velocity: wp.spatial_vectorf, motion: wp.spatial_vectorf) -> wp.spatial_vectorf:
    """Rate of change of ``motion`` in a frame that moves with ``velocity`` (Featherstone's cross product; angular part first)."""
    turn = wp.spatial_top(velocity)
    return wp.spatial_vector(
        wp.cross(turn, wp.spatial_top(motion)),
        wp.cross(turn, wp.spatial_bottom(motion)) + wp.cross(wp.spatial_bottom(velocity), wp.spatial_top(motion)),
    )


@wp.func
def _bias(dynamics: _Dynamics, world: int, body: int) -> wp.spatial_vectorf:
    """Acceleration of a body beyond its parent's from the joints' rates alone: sum of d/dt(axis) times rate over its joints.

    The rates are those before the step, which has overwritten them since: they are taken from the bodies' velocities. Several joints
    on one body can't be separated there, and their rates are calculated back from the acceleration.
    """
    first = dynamics.body_dofadr[body]
    count = dynamics.body_dofnum[body]
    bias = wp.spatial_vector()
    if count == 0:
        return bias
    of_parent = dynamics.cvel[world, dynamics.body_parentid[body]]
    if count == 1:
        return _motion_cross(of_parent, dynamics.cvel[world, body])
    turn = wp.spatial_top(dynamics.cvel[world, body]) - wp.spatial_top(of_parent)
    for dof in range(first, first + count):
        rate = dynamics.qvel[world, dof] - dynamics.timestep * dynamics.qacc[world, dof]
        # a free or ball joint alone: its axes of rotation are at right angles, and those that shift have no bias
        if dynamics.body_jntnum[body] == 1:
            rate = wp.dot(wp.spatial_top(dynamics.cdof[world, dof]), turn)
        bias = bias + rate * dynamics.cdof_dot[world, dof]
    return bias


@wp.kernel
def _accelerate(dynamics: _Dynamics, chain: wp.array[wp.int32], local: wp.transform, imu: ImuArrays):
    """The accelerometer's reading for the last physics step: as ``mj_rnePostConstraint`` and ``mj_objectAcceleration`` of MuJoCo.

    Everything is in the state before that step, about the centre of mass of the whole tree.
    """
    world = wp.tid()
    acceleration = wp.spatial_vector(wp.vec3(0.0, 0.0, 0.0), -_gravity(dynamics, world))
    for index in range(chain.shape[0]):
        body = chain[index]
        first = dynamics.body_dofadr[body]
        for dof in range(first, first + dynamics.body_dofnum[body]):
            acceleration = acceleration + dynamics.qacc[world, dof] * dynamics.cdof[world, dof]
        acceleration = acceleration + _bias(dynamics, world, body)
    body = chain[chain.shape[0] - 1]
    turn = dynamics.xmat[world, body] * wp.quat_to_matrix(wp.transform_get_rotation(local))
    position = dynamics.xpos[world, body] + dynamics.xmat[world, body] * wp.transform_get_translation(local)
    arm = position - dynamics.subtree_com[world, dynamics.body_rootid[body]]
    velocity = dynamics.cvel[world, body]
    angular = wp.spatial_top(velocity)
    linear = wp.spatial_bottom(velocity) + wp.cross(angular, arm)
    here = wp.spatial_bottom(acceleration) + wp.cross(wp.spatial_top(acceleration), arm) + wp.cross(angular, linear)
    imu.accelerometer[world] = wp.transpose(turn) * here


@wp.kernel
def _rest(ages: wp.array[wp.int32], dynamics: _Dynamics, imu: ImuArrays):
    """The accelerometer's reading for a world that was placed afresh."""
    world = wp.tid()
    if ages[world] == 0:
        imu.accelerometer[world] = -wp.quat_rotate_inv(imu.rotations[world], _gravity(dynamics, world))


@wp.kernel
def _move(bodies: BodyArrays, body: int, local: wp.transform, imu: ImuArrays):
    """The current readings of gyro and velocimeter, and the unit's orientation."""
    world = wp.tid()
    pose = place_pose(bodies, world, body, local)
    turn = wp.transform_get_rotation(pose)
    linear, angular = place_velocity(bodies, world, body, wp.transform_get_translation(pose))
    imu.rotations[world] = turn
    imu.gyro[world] = wp.quat_rotate_inv(turn, angular)
    imu.velocimeter[world] = wp.quat_rotate_inv(turn, linear)


class ImuSensor(Sensor):
    """An :class:`Imu` of some worlds."""

    needs_bodies = True
    state = ("gyro", "accelerometer", "velocimeter", "rotations")

    def __init__(self, declared: Imu, context: SensorContext) -> None:
        (self._place,) = declared.places(context.views)
        super().__init__(context, [self._place.name])
        solver = self._worlds.solver
        self._dynamics = _dynamics(solver, self._worlds.timestep)
        self._chain = wp.array(_chain(self._place, solver), dtype=wp.int32, device=self._device)
        self.arrays = filled(ImuArrays, self._device, (self._count,))

    def advance(self) -> None:
        """Measure the present velocities, and the acceleration of the last physics step."""
        self._move()
        self._launch(_accelerate, self._count, self._dynamics, self._chain, self._place.pose, self.arrays)

    def settle(self) -> None:
        """Measure the velocities again; worlds that were just reset are at rest."""
        self._move()
        self._launch(_rest, self._count, self._episodes.ages, self._dynamics, self.arrays)

    def _move(self) -> None:
        self._launch(_move, self._count, self._bodies, self._place.body, self._place.pose, self.arrays)


@dataclass(frozen=True)
class Imu(SensorDeclaration):
    """Gyro, accelerometer, velocimeter and orientation of a site or body, as MuJoCo's sensors define them.

    Attributes:
        site: The site that carries it, on a body that moves. Give this or ``body``.
        body: The body that carries it, at its origin.
        robot: The robot with that site or body.
    """

    site: str | None = None
    body: str | None = None
    robot: str = "robot"
    arrays_type: ClassVar[Any] = ImuArrays
    sensor_type: ClassVar[Any] = ImuSensor


def _dynamics(solver: Any, timestep: float) -> Any:
    """The :class:`_Dynamics` of a solver: views of its own arrays, whose addresses never change."""
    model, data = solver.mjw_model, solver.mjw_data
    parts = ("parentid", "rootid", "jntnum", "dofnum", "dofadr")
    views = {f"body_{name}": getattr(model, f"body_{name}") for name in parts}
    for name in ("xpos", "xmat", "subtree_com", "cvel", "cdof", "cdof_dot", "qvel", "qacc"):
        views[name] = getattr(data, name)
    return filled(_Dynamics, None, timestep=timestep, gravity=model.opt.gravity, **views)


def _chain(place: BodyFrame, solver: Any) -> list[int]:
    """The solver's bodies from the root of the tree to the body of the place."""
    columns = solver.mjc_body_to_newton.numpy()[0].tolist()
    if place.body not in columns[1:]:
        raise ValueError(f"Imu: {place.name} is fixed to the world, so it never moves; name one on a moving body")
    body: int = columns.index(place.body, 1)
    chain: list[int] = []
    while body:
        chain.insert(0, body)
        body = int(solver.mj_model.body_parentid[body])
    return chain
