"""Footing: feet and bodies above the scanned ground around them, measured as in mjlab.

A term with ``scan`` reads a :class:`worker.simulation.sensors.height_scan.HeightScan`, with or without a terrain. In a scan around feet,
``points`` is the number of points of each foot; column ``index`` of every sensor of a term must be the same foot. A term with a velocity
command is 0 unless the command exceeds its ``threshold``, speed [m/s] + turning velocity [rad/s].
"""

from __future__ import annotations

import warp as wp

from worker.simulation.episodes import EpisodeArrays
from worker.simulation.kinematics import body_rotation_of
from worker.simulation.robot_arrays import BodyArrays
from worker.simulation.sensors.contact import ContactArrays
from worker.simulation.sensors.frames import FrameArrays
from worker.simulation.sensors.height_scan import HeightScanArrays
from worker.tasks.declare.term_needs import needs
from worker.tasks.terms.composing import likeness, planar_squared
from worker.tasks.terms.feet import clearance_error, swing_error

wp.set_module_options({"enable_backward": False})


_PLANE = wp.constant(0.1)
"""Points are near a plane if their least variance is below this times the next."""
_LINE = wp.constant(1.0e-6)
"""Points are on a line if their second variance is not above this times the greatest."""


@needs(points="points")
@wp.func
def frame_clearance(world: int, scan: HeightScanArrays, index: int, points: int) -> float:
    """Least height of frame ``index`` of a scan above the ground at its points, not below 0 [m], such as of a foot.

    mjlab: foot_height.
    """
    least = scan.heights[world, index * points]
    for point in range(1, points):
        least = wp.min(least, scan.heights[world, index * points + point])
    return wp.max(least, 0.0)


@needs(points="points")
@wp.func
def swung_foot_clearance(
    world: int,
    episodes: EpisodeArrays,
    frames: FrameArrays,
    scan: HeightScanArrays,
    index: int,
    command: int,
    points: int,
    height: float,
    threshold: float = 0.01,
) -> float:
    """|h - height| times the planar speed of a foot [m^2/s], h its :func:`frame_clearance`, while the command asks for more than ``threshold``.

    mjlab: feet_clearance.
    """
    clearance = frame_clearance(world, scan, index, points)
    return clearance_error(world, episodes, frames, clearance, index, command, height, threshold)


@needs(memory_each=1, points="points")
@wp.func
def swung_foot_height_error(
    world: int,
    episodes: EpisodeArrays,
    contacts: ContactArrays,
    scan: HeightScanArrays,
    index: int,
    command: int,
    memory: int,
    points: int,
    height: float,
    threshold: float = 0.01,
) -> float:
    """At touchdown (p / height - 1)^2, p the greatest :func:`frame_clearance` of the foot in its swing [m], else 0.

    It counts while the command asks for more than ``threshold``.

    mjlab: feet_swing_height.
    """
    clearance = frame_clearance(world, scan, index, points)
    return swing_error(world, episodes, contacts, clearance, index, command, memory, height, threshold)


@wp.func
def nearest_plane_normal(scan: HeightScanArrays, world: int, most: int) -> wp.vec3:
    """Upward normal of the plane nearest to at most ``most`` points of a scan, evenly chosen; up where they are near no plane.

    The sum of squared distances from the plane is least: its normal is the eigenvector of the least eigenvalue of the points'
    covariance (mjlab's ``fit_terrain_normal``).
    """
    total = scan.points.shape[1]
    count = wp.min(total, most)
    middle = wp.vec3(0.0, 0.0, 0.0)
    for number in range(count):
        middle = middle + scan.points[world, number * (total - 1) // wp.max(count - 1, 1)] / float(count)
    spread = wp.mat33()
    for number in range(count):
        way = scan.points[world, number * (total - 1) // wp.max(count - 1, 1)] - middle
        spread = spread + wp.outer(way, way)
    vectors, values = wp.eig3(spread)
    first = int(0)  # noqa: RUF046 (a variable for Warp, not a constant)
    last = int(0)  # noqa: RUF046
    for axis in range(1, 3):
        if values[axis] < values[first]:
            first = axis
        if values[axis] >= values[last]:
            last = axis
    second = values[0] + values[1] + values[2] - values[first] - values[last]
    # written so that NaN is near no plane
    if not (values[first] < _PLANE * second and second > _LINE * values[last]):
        return wp.vec3(0.0, 0.0, 1.0)
    normal = wp.normalize(wp.vec3(vectors[0, first], vectors[1, first], vectors[2, first]))
    return wp.where(normal[2] < 0.0, -normal, normal)


@wp.func
def body_upright_on_ground(
    world: int, bodies: BodyArrays, scan: HeightScanArrays, body: int, std: float, most: int = 32
) -> float:
    """exp(-sin(tilt)^2 / std^2), tilt the angle between a body's z axis and the normal of the plane nearest to a scan's points.

    At most ``most`` points count, evenly chosen; where they are near no plane the normal is up.

    mjlab: upright (with terrain sensors).
    """
    local = wp.quat_rotate_inv(body_rotation_of(bodies, world, body), nearest_plane_normal(scan, world, most))
    return likeness(planar_squared(local), std)
