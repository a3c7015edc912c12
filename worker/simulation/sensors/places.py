"""Places on robots: bodies and sites as frames on bodies, with their poses and velocities."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import warp as wp

from shared_store.contract.error_text import nearest
from worker.simulation.robot_arrays import BodyArrays
from worker.simulation.robot_view import RobotView
from worker.simulation.sensors.sensor import SensorContext

wp.set_module_options({"enable_backward": False})


@dataclass(frozen=True)
class BodyFrame:
    """A frame on a body.

    Attributes:
        name: Name of the body or site.
        body: Column of the body in ``BodyArrays``; -1: the frame is fixed to the world.
        pose: Pose in the frame of the body or the world [m, quaternion xyzw].
    """

    name: str
    body: int
    pose: wp.transform


def find_places(
    context: SensorContext,
    what: str,
    robot: str,
    bodies: str | Iterable[str] | None,
    sites: str | Iterable[str] | None,
) -> list[BodyFrame]:
    """The frames of bodies or of sites.

    Args:
        context: The worlds.
        what: Name of the sensor, for errors.
        robot: Name of the robot.
        bodies: Pattern or patterns of the bodies; give this or ``sites``.
        sites: Pattern or patterns of the sites.

    Raises:
        ValueError: Neither or both are given, or one of them matches nothing.
    """
    if (bodies is None) == (sites is None):
        raise ValueError(f"{what}: give either bodies or sites, a pattern or several, and not both")
    view = context.view(robot, f"{what}.robot")
    if sites is not None:
        return [
            BodyFrame(view.site_names[index], view.site_bodies[index], view.site_poses[index])
            for index in view.find_sites(sites)
        ]
    assert bodies is not None  # as was checked above
    return [
        BodyFrame(view.body_names[index], view.bodies[index], wp.transform_identity())
        for index in view.find_bodies(bodies)
    ]


def place_names(
    views: Mapping[str, RobotView],
    what: str,
    robot: str,
    *,
    bodies: str | Iterable[str] | None = None,
    sites: str | Iterable[str] | None = None,
    geoms: str | Iterable[str] | None = None,
) -> list[str]:
    """The names that patterns match, before any worlds exist.

    Args:
        views: The robots and objects by name.
        what: Name of the sensor, for errors.
        robot: Name of the robot.
        bodies: Pattern or patterns of bodies; give one of these three.
        sites: Pattern or patterns of sites.
        geoms: Pattern or patterns of geoms.

    Raises:
        ValueError: None or several are given, the robot is unknown, or a pattern matches nothing.
    """
    if robot not in views:
        raise ValueError(f"{what}.robot: there is no robot {robot!r}; {nearest(robot, views)}")
    view = views[robot]
    kinds = {"bodies": (bodies, view.find_bodies, view.body_names), "sites": (sites, view.find_sites, view.site_names)}
    kinds["geoms"] = (geoms, view.find_geoms, view.geom_names)
    given = [(patterns, search, names) for patterns, search, names in kinds.values() if patterns is not None]
    if len(given) != 1:
        raise ValueError(f"{what}: give one of bodies, sites and geoms, as the sensor takes them, a pattern or several")
    patterns, search, names = given[0]
    return [names[index] for index in search(patterns)]


def only_one(places: list[BodyFrame], what: str) -> BodyFrame:
    """The only place. Raises ValueError where a pattern matches several."""
    if len(places) != 1:
        raise ValueError(f"{what}: name one body or site; the pattern matches {', '.join(p.name for p in places)}")
    return places[0]


@wp.func
def place_pose(bodies: BodyArrays, world: int, body: int, local: wp.transform) -> wp.transform:
    """Pose of a place in the world frame [m, quaternion xyzw]."""
    if body < 0:
        return local
    return wp.transform_multiply(bodies.poses[world, body], local)


@wp.func
def place_velocity(bodies: BodyArrays, world: int, body: int, position: wp.vec3):
    """Linear [m/s] and angular [rad/s] velocity, in the world frame, of the point of a body that is at ``position``."""
    linear = wp.vec3(0.0, 0.0, 0.0)
    angular = wp.vec3(0.0, 0.0, 0.0)
    if body >= 0:
        velocity = bodies.velocities[world, body]
        center = wp.transform_point(bodies.poses[world, body], bodies.coms[world, body])
        angular = wp.spatial_bottom(velocity)
        linear = wp.spatial_top(velocity) + wp.cross(angular, position - center)
    return linear, angular
