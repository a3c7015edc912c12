"""Places on robots: bodies and sites as frames on bodies, with their poses and velocities."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import warp as wp

from shared_store.contract.error_text import nearest
from worker.simulation.robot_arrays import BodyArrays

if TYPE_CHECKING:
    from worker.simulation.robot_view import RobotView

wp.set_module_options({"enable_backward": False})

Patterns = str | Iterable[str] | None


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


def view_of(views: Mapping[str, RobotView], robot: str, what: str) -> RobotView:
    """The robot or object of a name. Raises ValueError, which begins with ``what``, where there is none."""
    if robot not in views:
        raise ValueError(f"{what}: there is no robot {robot!r}; {nearest(robot, views)}")
    return views[robot]


def find_places(
    views: Mapping[str, RobotView], what: str, robot: str, bodies: Patterns, sites: Patterns
) -> list[BodyFrame]:
    """The frames of bodies or of sites.

    Args:
        views: The robots and objects by name.
        what: Name of the sensor, for errors.
        robot: Name of the robot.
        bodies: Pattern or patterns of the bodies; give this or ``sites``.
        sites: Pattern or patterns of the sites.

    Raises:
        ValueError: Neither or both are given, the robot is unknown, or a pattern matches nothing.
    """
    if (bodies is None) == (sites is None):
        raise ValueError(f"{what}: give either bodies or sites, a pattern or several, and not both")
    view = view_of(views, robot, f"{what}.robot")
    if sites is None:
        found = view.find_bodies(bodies or ())
        return [BodyFrame(view.body_names[each], view.bodies[each], wp.transform_identity()) for each in found]
    found = view.find_sites(sites)
    return [BodyFrame(view.site_names[each], view.site_bodies[each], view.site_poses[each]) for each in found]


def find_place(views: Mapping[str, RobotView], what: str, robot: str, body: str | None, site: str | None) -> BodyFrame:
    """The frame of one body or site; arguments and errors as of :func:`find_places`, and a pattern must not match several."""
    if (body is None) == (site is None):
        raise ValueError(f"{what}: give either body or site, and not both")
    places = find_places(views, what, robot, body, site)
    if len(places) != 1:
        raise ValueError(f"{what}: name one body or site; the pattern matches {', '.join(p.name for p in places)}")
    return places[0]


def place_names(views: Mapping[str, RobotView], what: str, robot: str, **patterns: Patterns) -> list[str]:
    """The names that patterns of ``bodies``, ``sites`` or ``geoms`` match, one of which is given; other arguments as of :func:`find_places`.

    Raises:
        ValueError: None or several are given, the robot is unknown, or a pattern matches nothing.
    """
    view = view_of(views, robot, f"{what}.robot")
    given = {kind: found for kind, found in patterns.items() if found is not None}
    if len(given) != 1:
        raise ValueError(f"{what}: give one of {' and '.join(patterns)}, a pattern or several")
    kinds = {
        "bodies": (view.find_bodies, view.body_names),
        "sites": (view.find_sites, view.site_names),
        "geoms": (view.find_geoms, view.geom_names),
    }
    ((kind, found),) = given.items()
    search, names = kinds[kind]
    return [names[index] for index in search(found)]


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
