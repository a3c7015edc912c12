"""The car's lidar: rays in the plane from its middle, which meet obstacles and nothing of the road, as DeepRacer's does."""

from __future__ import annotations

import warp as wp

from racer.car.car_arrays import CarArrays

wp.set_module_options({"enable_backward": False})


@wp.func
def meets_slab(start: float, way: float, half: float) -> wp.vec2:
    """From where to where along a ray it is within ``half`` of 0 in one direction; the first is greater where it never is.

    Args:
        start: Where it begins.
        way: By how much it comes on for each metre.
        half: [m].
    """
    if wp.abs(way) < 1.0e-9:
        if wp.abs(start) <= half:
            return wp.vec2(-1.0e9, 1.0e9)
        return wp.vec2(1.0e9, -1.0e9)
    first = (-half - start) / way
    second = (half - start) / way
    return wp.vec2(wp.min(first, second), wp.max(first, second))


@wp.func
def distance_along(pose: wp.vec3, angle: float, box: wp.vec3, half: wp.vec2) -> float:
    """Distance from a pose to a box along the direction ``angle`` [rad] [m]; 0 from inside it, 1e9 where the ray misses it."""
    cosine = wp.cos(box[2])
    sine = wp.sin(box[2])
    x = pose[0] - box[0]
    y = pose[1] - box[1]
    along = meets_slab(x * cosine + y * sine, wp.cos(angle - box[2]), half[0])
    across = meets_slab(y * cosine - x * sine, wp.sin(angle - box[2]), half[1])
    begin = wp.max(along[0], across[0])
    end = wp.min(along[1], across[1])
    found = float(1.0e9)
    if begin <= end and end >= 0.0:
        found = wp.max(begin, 0.0)
    return found


@wp.func
def lidar_sees(
    world: int,
    car: CarArrays,
    index: int,
    sectors: int,
    rays: int,
    levels: int,
    field: float,
    least: float,
    reach: float,
) -> float:
    """One number of what the lidar sees.

    Args:
        world: Row.
        car: The cars.
        index: Of the number: sector after sector from the right to the left, and of each its levels from near to far.
        sectors: Equal parts of the field.
        rays: Of each sector.
        levels: 0: the number is the least distance in the sector [m]; else 1 where that is in this of so many parts of the range, or 0.
        field: Angle that is seen, half of it to each side of the heading [rad].
        least: A shorter distance is this one [m].
        reach: What is farther is not seen [m].
    """
    parts = wp.max(levels, 1)
    sector = index / parts
    track = car.tracks[world]
    pose = car.poses[world]
    nearest = float(1.0e9)
    for ray in range(rays):
        share = (float(sector * rays + ray) + 0.5) / float(sectors * rays)
        angle = pose[2] + field * (share - 0.5)
        for number in range(car.obstacle_poses.shape[1]):
            found = distance_along(pose, angle, car.obstacle_poses[track, number], car.obstacle_half)
            nearest = wp.min(nearest, found)
    value = wp.clamp(nearest, least, reach)
    if levels > 0:
        part = wp.min(int(float(levels) * (value - least) / (reach - least)), levels - 1)
        value = 0.0
        if nearest <= reach and part == index % parts:
            value = 1.0
    return value
