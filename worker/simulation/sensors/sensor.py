"""What all sensors share: declaration, construction, the order of their launches, and places on robots: bodies and sites as frames."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import torch
import warp as wp

from shared_store.contract.error_text import nearest
from worker.simulation.episodes import EpisodeArrays
from worker.simulation.robot_arrays import BodyArrays, RobotArrays
from worker.simulation.structs import views_of
from worker.simulation.worlds import Worlds

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
    named = {kind: found for kind, found in patterns.items() if found is not None}
    if len(named) != 1:
        raise ValueError(f"{what}: give one of {' and '.join(patterns)}, a pattern or several")
    kinds = {
        "bodies": (view.find_bodies, view.body_names),
        "sites": (view.find_sites, view.site_names),
        "geoms": (view.find_geoms, view.geom_names),
    }
    ((kind, found),) = named.items()
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


@dataclass(frozen=True)
class SensorContext:
    """Context from which sensors are built.

    Attributes:
        worlds: The measured worlds.
        views: View of each robot or object, by name.
        robots: Columns of each robot in the rows of a world, by name.
        bodies: Poses and velocities of the bodies of all worlds.
        episodes: The task's buffers; ``ages`` is 0 in worlds that were just reset.
        terrain: The terrain that the task declares; None for a plane or no ground.
        control_hz: Control steps per simulated second [Hz].
        name: Name of the sensor in the task's declaration.
    """

    worlds: Worlds
    views: Mapping[str, RobotView]
    robots: Mapping[str, RobotArrays]
    bodies: BodyArrays
    episodes: EpisodeArrays
    terrain: Any
    control_hz: float
    name: str = ""

    @property
    def device(self) -> str:
        """Device of all arrays, ``"cpu"`` or ``"cuda:<n>"``."""
        return str(self.worlds.model.device)

    def view(self, name: str, what: str) -> RobotView:
        """The robot or object of this name; ``what`` names sensor and argument for the ValueError where there is none."""
        return view_of(self.views, name, what)

    def array(self, shape: tuple[int, ...], dtype: Any) -> wp.array[Any]:
        """A cleared array on the device of the worlds."""
        return wp.zeros(shape, dtype=dtype, device=self.device)


class Sensor:
    """Measures all worlds; its methods are launches only, so that they can be captured. By default it measures nothing.

    Args:
        context: The worlds.
        names: See below.

    Attributes:
        arrays: An instance of a Warp struct, one row per world. A term reads it through a parameter of the struct's type.
        needs_bodies: Whether body poses must be current (``Worlds.update_bodies``) when the methods below are called.
        names: Names of its columns: bodies, geoms or sites.
        state: Fields of ``arrays`` that the next step reads.
    """

    arrays: Any
    needs_bodies: bool = False
    state: tuple[str, ...] = ()

    def __init__(self, context: SensorContext, names: Iterable[str]) -> None:
        self.names = tuple(names)
        self._context, self._worlds, self._device = context, context.worlds, context.device
        self._bodies, self._episodes, self._count = context.bodies, context.episodes, context.worlds.world_count

    def _launch(self, kernel: wp.Kernel, dim: Any, *inputs: Any) -> None:
        wp.launch(kernel, dim=dim, inputs=inputs, device=self._device)

    def advance(self) -> None:
        """Measure, after the physics of a control step."""

    def settle(self) -> None:
        """Called after resets: worlds with ``episodes.ages[world] == 0`` forget their past."""

    def state_tensors(self) -> dict[str, torch.Tensor]:
        """Live views of the state that the next step reads, by name, each with leading dimension ``worlds``."""
        return views_of(self.arrays, *self.state)


class SensorDeclaration:
    """Declaration of a sensor: an immutable value without arrays.

    Attributes:
        arrays_type: Struct type of its sensor's ``arrays``.
        sensor_type: Type of its sensor, made of the declaration and a :class:`SensorContext`.
    """

    arrays_type: ClassVar[Any]
    sensor_type: ClassVar[Any]

    def places(self, views: Mapping[str, RobotView]) -> list[BodyFrame]:
        """The frames that its fields ``bodies`` or ``sites`` match, or the one that ``body`` or ``site`` names.

        Raises:
            ValueError: Neither or both are given, the robot is unknown, a pattern matches nothing, or several where one is meant.
        """
        own: Any = self
        if hasattr(own, "body"):
            return [find_place(views, type(self).__name__, own.robot, own.body, own.site)]
        return find_places(views, type(self).__name__, own.robot, own.bodies, own.sites)

    def rows(self, views: Mapping[str, RobotView]) -> list[str]:
        """Name of each column, before any worlds exist.

        Raises:
            ValueError: It names something unknown, or a number is out of range.
        """
        return [place.name for place in self.places(views)]

    def build(self, context: SensorContext) -> Any:
        """The sensor of these worlds, of :attr:`sensor_type`.

        Raises:
            ValueError: As :meth:`rows`, or something can't be measured.
        """
        return self.sensor_type(self, context)
