"""The scene around the car: asphalt, white borders, a yellow dashed line in the middle, grass and boxes; and the car itself."""

from __future__ import annotations

import newton
import numpy as np
import warp as wp

from racer.tracks.arithmetic import Floats, nearest_points, norm
from racer.tracks.circuit import BOX, Circuit, bounds
from racer.tracks.geometry import place_at
from racer.tracks.race_track import Track

GRASS, ASPHALT, BORDER, DASHES = (0.26, 0.55, 0.2), (0.22, 0.23, 0.25), (0.95, 0.95, 0.95), (0.95, 0.75, 0.1)
CARDBOARD = (0.75, 0.2, 0.12)
"""Red, green and blue."""
BORDER_WIDTH = 0.05
DASH = (0.04, 0.3, 0.3)
"""Width of the line in the middle, length of a dash, and of the gap behind it [m]."""
FIELD = 30.0
"""Width of the grass beyond the tracks [m]."""
_BELOW, _ABOVE = -0.01, (0.002, 0.003)

CAR = """<mujoco model="racer"><compiler angle="radian"/><worldbody><body name="car">
  <inertial pos="0 0 0.05" mass="6.36" diaginertia="0.03 0.06 0.08"/>
  <joint name="x" type="slide" axis="1 0 0"/>
  <joint name="y" type="slide" axis="0 1 0"/>
  <joint name="heading" type="hinge" axis="0 0 1"/>
  <geom name="chassis" type="box" size="0.13 0.07 0.015" pos="0.01 0 0.045" rgba="0.12 0.12 0.14 1" contype="0" conaffinity="0"/>
  <geom name="cabin" type="box" size="0.07 0.055 0.03" pos="-0.03 0 0.09" rgba="0.1 0.35 0.75 1" contype="0" conaffinity="0"/>
  <geom name="mast" type="box" size="0.008 0.02 0.015" pos="0.035 0 0.135" rgba="0.3 0.3 0.3 1" contype="0" conaffinity="0"/>
  <body name="front_left" pos="0.082 0.08 0.035">
    <inertial pos="0 0 0" mass="0.34" diaginertia="0.0002 0.0004 0.0002"/>
    <joint name="steering" type="hinge" axis="0 0 1" range="-0.6 0.6"/>
    <geom name="front_left" type="cylinder" size="0.035 0.0125" euler="1.5708 0 0" rgba="0.05 0.05 0.05 1" contype="0" conaffinity="0"/>
  </body>
  <body name="front_right" pos="0.082 -0.08 0.035">
    <inertial pos="0 0 0" mass="0.34" diaginertia="0.0002 0.0004 0.0002"/>
    <joint name="steering_right" type="hinge" axis="0 0 1" range="-0.6 0.6"/>
    <geom name="front_right" type="cylinder" size="0.035 0.0125" euler="1.5708 0 0" rgba="0.05 0.05 0.05 1" contype="0" conaffinity="0"/>
  </body>
  <body name="rear_axle" pos="-0.082 0 0.035">
    <inertial pos="0 0 0" mass="0.68" diaginertia="0.0004 0.0008 0.0004"/>
    <joint name="speed" type="hinge" axis="0 1 0"/>
    <geom name="rear_left" type="cylinder" size="0.035 0.0125" pos="0 0.08 0" euler="1.5708 0 0" rgba="0.05 0.05 0.05 1" contype="0" conaffinity="0"/>
    <geom name="rear_right" type="cylinder" size="0.035 0.0125" pos="0 -0.08 0" euler="1.5708 0 0" rgba="0.05 0.05 0.05 1" contype="0" conaffinity="0"/>
  </body>
</body></worldbody>
<actuator><position joint="steering" kp="1"/><velocity joint="speed" kv="1"/></actuator></mujoco>"""
"""The car as MJCF. Nothing in it touches anything; the kinematic model of :mod:`racer.car.bicycle` moves it."""


def add_scenery(builder: newton.ModelBuilder, circuit: Circuit) -> None:
    """Add the ground of all tracks to a builder that holds one world, as shapes that are only seen."""
    tracks, corners = circuit.tracks, circuit.corners
    low = np.min([bounds(track)[0] + corner for track, corner in zip(tracks, corners, strict=True)], axis=0) - FIELD
    high = np.max([bounds(track)[1] + corner for track, corner in zip(tracks, corners, strict=True)], axis=0) + FIELD
    field = np.array([low, (high[0], low[1]), high, (low[0], high[1])])
    _add(builder, "grass", field, np.array([[0, 1, 2], [0, 2, 3]]), _BELOW, GRASS)
    for number, (track, corner) in enumerate(zip(tracks, corners, strict=True)):
        roads = _roads(track)
        for part, (inner, outer) in enumerate(roads):
            name = f"asphalt_{number}" if part == 0 else f"asphalt_{number}_{part}"
            _add(builder, name, *_strip(inner + corner, outer + corner, track.closed), 0.0, ASPHALT)
        inward, outward = _towards(*roads[0]), _towards(*roads[-1])
        edges = [(track.inner, track.inner + inward), (track.outer - outward, track.outer)]
        for side, (inner, outer) in zip(("inner", "outer"), edges, strict=True):
            strip = _strip(inner + corner, outer + corner, track.closed)
            _add(builder, f"{side}_border_{number}", *strip, _ABOVE[0], BORDER)
        _add(builder, f"dashes_{number}", *_dashes(track, corner), _ABOVE[1], DASHES)
        for box, (x, y, heading) in enumerate(circuit.obstacle_poses[number]):
            place = wp.transform(
                wp.vec3(x + corner[0], y + corner[1], BOX[2] / 2),
                wp.quat_from_axis_angle(wp.vec3(0, 0, 1), float(heading)),
            )
            x, y, z = (length / 2 for length in BOX)
            label = f"box_{number}_{box}"
            builder.add_shape_box(-1, xform=place, hx=x, hy=y, hz=z, cfg=_seen(), color=CARDBOARD, label=label)


def _seen() -> newton.ModelBuilder.ShapeConfig:
    return newton.ModelBuilder.ShapeConfig(density=0.0, has_shape_collision=False, has_particle_collision=False)


def _roads(track: Track) -> list[tuple[Floats, Floats]]:
    """Strips that cover the road together: the points of both borders, two of (N, 2) [m].

    Where the rows of the borders are level, it is one strip. Else it would be too narrow and stick out in curves, so one leads from the
    inner border straight across the road and one from the outer border.
    """
    inner, outer, closed = track.inner, track.outer, track.closed
    if track.slanted == 0:
        return [(inner, outer)]
    return [(inner, nearest_points(outer, inner, closed)), (nearest_points(inner, outer, closed), outer)]


def _towards(start: Floats, end: Floats) -> Floats:
    """From ``start`` (N, 2) as far as a border is wide, in the direction of ``end``."""
    offset = end - start
    step: Floats = BORDER_WIDTH * offset / norm(offset)[:, None]
    return step


def _strip(first: Floats, second: Floats, closed: bool = True) -> tuple[Floats, np.ndarray]:
    """Points (2 N, 2) and triangles (2 N, 3) between two lines of N points, or (2 N - 2, 3) between open ones."""
    count = len(first)
    row = np.arange(count if closed else count - 1)
    following = (row + 1) % count
    near = np.stack((row, following, following + count), -1)
    far = np.stack((row, following + count, row + count), -1)
    return np.concatenate((first, second)), np.concatenate((near, far))


def _dashes(track: Track, corner: Floats) -> tuple[Floats, np.ndarray]:
    """Points and triangles of the line in the middle: short pieces, so that it bends with the road."""
    width, length, gap = DASH
    pieces = 4
    count = max(1, round(track.length / (length + gap)))
    starts = track.length / count * np.arange(count)
    along = (starts[:, None] + length * np.arange(pieces + 1) / pieces).ravel()
    points, headings = place_at(track, along)
    side = 0.5 * width * np.stack((-np.sin(headings), np.cos(headings)), -1)
    both = np.concatenate((points - side, points + side)) + corner
    row = (np.arange(count)[:, None] * (pieces + 1) + np.arange(pieces)).ravel()
    other = len(points)
    near = np.stack((row, row + 1, row + 1 + other), -1)
    far = np.stack((row, row + 1 + other, row + other), -1)
    return both, np.concatenate((near, far))


def _add(
    builder: newton.ModelBuilder,
    name: str,
    points: Floats,
    triangles: np.ndarray,
    height: float,
    color: tuple[float, float, float],
) -> None:
    """Add a flat mesh, seen from above whichever way round its triangles are."""
    first, second, third = (points[triangles[:, corner]] for corner in range(3))
    area = (second - first)[:, 0] * (third - first)[:, 1] - (second - first)[:, 1] * (third - first)[:, 0]
    triangles = np.where((area < 0)[:, None], triangles[:, ::-1], triangles)
    vertices = np.column_stack((points, np.full(len(points), height)))
    mesh = newton.Mesh(vertices.astype(np.float32), triangles.ravel().astype(np.int32), compute_inertia=False)
    builder.add_shape_mesh(-1, mesh=mesh, cfg=_seen(), color=color, label=name)
