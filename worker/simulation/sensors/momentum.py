"""Momentum of a whole robot about its centre of mass."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import newton
import warp as wp

from worker.simulation.robot_arrays import BodyArrays
from worker.simulation.robot_view import RobotView
from worker.simulation.sensors.sensor import Sensor, SensorContext, SensorDeclaration, find_place, view_of
from worker.simulation.structs import filled

wp.set_module_options({"enable_backward": False})


@wp.struct
class MomentumArrays:
    """Momentum of one robot, one row per world, in the world frame.

    Attributes:
        angular: Angular momentum about the common centre of mass [kg m^2/s], shape ``(worlds,)``.
        velocities: Velocity of the common centre of mass [m/s], shape ``(worlds,)``.
        centers: Common centre of mass [m], shape ``(worlds,)``.
        masses: Common mass [kg], shape ``(worlds,)``.
    """

    angular: wp.array[wp.vec3]
    velocities: wp.array[wp.vec3]
    centers: wp.array[wp.vec3]
    masses: wp.array[wp.float32]


@wp.kernel
def _measure(
    columns: wp.array[wp.int32],
    bodies: BodyArrays,
    body_masses: wp.array2d[wp.float32],
    body_inertias: wp.array2d[wp.mat33],
    momentum: MomentumArrays,
):
    """Sum one world's bodies: sum of R I R^T w + m (r - c) x v, which needs no v - v_c since sum of m (r - c) is 0."""
    world = wp.tid()
    mass = float(0.0)
    moment = wp.vec3(0.0, 0.0, 0.0)
    linear = wp.vec3(0.0, 0.0, 0.0)
    for index in range(columns.shape[0]):
        body = columns[index]
        share = body_masses[world, body]
        center = wp.transform_point(bodies.poses[world, body], bodies.coms[world, body])
        mass = mass + share
        moment = moment + share * center
        linear = linear + share * wp.spatial_top(bodies.velocities[world, body])
    middle = moment / mass
    velocity = linear / mass

    angular = wp.vec3(0.0, 0.0, 0.0)
    for index in range(columns.shape[0]):
        body = columns[index]
        pose = bodies.poses[world, body]
        center = wp.transform_point(pose, bodies.coms[world, body])
        own = wp.spatial_bottom(bodies.velocities[world, body])
        turn = wp.transform_get_rotation(pose)
        spin = wp.quat_rotate(turn, body_inertias[world, body] * wp.quat_rotate_inv(turn, own))
        # less rounding than with v, of a robot that is fast
        orbit = wp.cross(center - middle, wp.spatial_top(bodies.velocities[world, body]) - velocity)
        angular = angular + spin + body_masses[world, body] * orbit
    momentum.angular[world] = angular
    momentum.velocities[world] = velocity
    momentum.centers[world] = middle
    momentum.masses[world] = mass


class MomentumSensor(Sensor):
    """:class:`AngularMomentum` of some worlds."""

    needs_bodies = True
    state = ("angular", "velocities", "centers", "masses")

    def __init__(self, declared: AngularMomentum, context: SensorContext) -> None:
        super().__init__(context, declared.rows(context.views))
        view, model = context.views[declared.robot], self._worlds.model
        columns = list(view.bodies)
        if declared.body is not None:
            columns = _outwards(view.bodies[view.body_names.index(self.names[0])], model)
        self._masses = model.body_mass.reshape((self._count, -1))
        self._inertias = model.body_inertia.reshape((self._count, -1))
        if not self._masses.numpy()[:, columns].sum(1).all():
            raise ValueError(f"AngularMomentum: {self.names[0]} has no mass, so it has no centre of mass")
        self._columns = wp.array(columns, dtype=wp.int32, device=self._device)
        self.arrays = filled(MomentumArrays, self._device, (self._count,))

    def advance(self) -> None:
        """Measure the present momenta."""
        self._launch(_measure, self._count, self._columns, self._bodies, self._masses, self._inertias, self.arrays)

    def settle(self) -> None:
        """Measure again, since resets moved some worlds."""
        self.advance()


def _outwards(root: int, model: newton.Model) -> list[int]:
    """A body of the first world and all its descendants."""
    parents, children = model.joint_parent.numpy(), model.joint_child.numpy()
    found, new = {root}, {root}
    while new:
        new = {int(child) for parent, child in zip(parents, children, strict=True) if int(parent) in new} - found
        found |= new
    return sorted(found)


@dataclass(frozen=True)
class AngularMomentum(SensorDeclaration):
    """Angular momentum of a robot about its centre of mass: MuJoCo's ``subtreeangmom``, ``subtreelinvel`` and ``subtreecom``.

    Attributes:
        robot: The robot.
        body: Root of the subtree that counts; None: the whole robot.
    """

    robot: str = "robot"
    body: str | None = None
    arrays_type: ClassVar[Any] = MomentumArrays
    sensor_type: ClassVar[Any] = MomentumSensor

    def rows(self, views: Mapping[str, RobotView]) -> list[str]:
        """Name of the robot or of the subtree's root. Raises ValueError where a name matches nothing, or ``body`` several."""
        view_of(views, self.robot, "AngularMomentum.robot")
        if self.body is None:
            return [self.robot]
        return [find_place(views, "AngularMomentum.body", self.robot, self.body, None).name]
