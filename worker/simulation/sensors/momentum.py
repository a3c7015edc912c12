"""Momentum of a whole robot about its centre of mass."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import newton
import torch
import warp as wp

from worker.simulation.robot_arrays import BodyArrays
from worker.simulation.robot_view import RobotView
from worker.simulation.sensors.places import place_names
from worker.simulation.sensors.sensor import SensorContext, views_of

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


@dataclass(frozen=True)
class AngularMomentum:
    """Angular momentum of a robot about its centre of mass: MuJoCo's ``subtreeangmom``, ``subtreelinvel`` and ``subtreecom``.

    Attributes:
        robot: The robot.
        body: Root of the subtree that counts; None: the whole robot.
    """

    robot: str = "robot"
    body: str | None = None
    arrays_type: ClassVar[Any] = MomentumArrays

    def rows(self, views: Mapping[str, RobotView]) -> list[str]:
        """Name of each column, of these robots and objects. Raises ValueError where a pattern or a name matches nothing."""
        return (
            [self.robot] if self.body is None else place_names(views, "AngularMomentum", self.robot, bodies=self.body)
        )

    def build(self, context: SensorContext) -> MomentumSensor:
        """The sensor of these worlds.

        Raises:
            ValueError: A name matches nothing, ``body`` matches several bodies, or the subtree has no mass.
        """
        view = context.view(self.robot, "AngularMomentum.robot")
        if self.body is None:
            return MomentumSensor(self.robot, list(view.bodies), context)
        roots = view.find_bodies(self.body)
        if len(roots) != 1:
            matches = ", ".join(view.body_names[root] for root in roots)
            raise ValueError(f"AngularMomentum.body: name one body; the pattern matches {matches}")
        columns = _outwards(view.bodies[roots[0]], context.worlds.model)
        return MomentumSensor(view.body_names[roots[0]], columns, context)


def _outwards(root: int, model: newton.Model) -> list[int]:
    """A body of the first world and all its descendants."""
    parents, children = model.joint_parent.numpy(), model.joint_child.numpy()
    found, new = {root}, {root}
    while new:
        new = {int(child) for parent, child in zip(parents, children, strict=True) if int(parent) in new} - found
        found |= new
    return sorted(found)


class MomentumSensor:
    """:class:`AngularMomentum` of some worlds; see :class:`worker.simulation.sensors.sensor.Sensor`.

    Args:
        name: Name of the robot or its part.
        columns: Columns of its bodies in ``BodyArrays``.
        context: The worlds.

    Raises:
        ValueError: The bodies have no mass.
    """

    needs_bodies = True

    def __init__(self, name: str, columns: list[int], context: SensorContext) -> None:
        self.names = (name,)
        self._bodies, self._device = context.bodies, context.device
        self._count = context.worlds.world_count
        model = context.worlds.model
        self._masses = model.body_mass.reshape((self._count, -1))
        self._inertias = model.body_inertia.reshape((self._count, -1))
        if not self._masses.numpy()[:, columns].sum(1).all():
            raise ValueError(f"AngularMomentum: {name} has no mass, so it has no centre of mass")
        self._columns = wp.array(columns, dtype=wp.int32, device=self._device)
        self.arrays = MomentumArrays()
        for field in ("angular", "velocities", "centers"):
            setattr(self.arrays, field, context.array((self._count,), wp.vec3))
        self.arrays.masses = context.array((self._count,), wp.float32)

    def advance(self) -> None:
        """Measure the present momenta."""
        inputs = [self._columns, self._bodies, self._masses, self._inertias, self.arrays]
        wp.launch(_measure, dim=self._count, inputs=inputs, device=self._device)

    def settle(self) -> None:
        """Measure again, since resets moved some worlds."""
        self.advance()

    def state_tensors(self) -> dict[str, torch.Tensor]:
        """All measurements: code before the next physics reads them."""
        return views_of(self.arrays, "angular", "velocities", "centers", "masses")
