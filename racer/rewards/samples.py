"""Sample inputs of reward functions: cars, and objects, placed on the tracks of a job, or on an oval that is computed here."""

from __future__ import annotations

import math
import random
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from racer.rewards.parameters import BY_NAME, MOST_OBJECTS, PARAMETERS, Point

WIDTH = 1.07
"""Width of the oval's road [m]."""
SIX = 6
"""Objects with which AWS tries every function."""
_CAR = 0.08
"""Half the width of a car [m]."""


@dataclass(frozen=True)
class Placed:
    """Something on the track.

    Attributes:
        way: Along the centre line from the start, in the line's own direction [m].
        offset: From the centre line to the left [m]: of a car in its direction, of an object in the line's.
        turned: From the direction of the track to the left [degrees].
        speed: In m/s.
    """

    way: float
    offset: float = 0.0
    turned: float = 0.0
    speed: float = 0.0


class CentreLine:
    """A centre line.

    Args:
        points: The first one of a closed line is also the last one [m].
        widths: Of the road at each of them [m].
        closed: Whether it is a loop.

    Attributes:
        points: As given.
        closed: As given.
        starts: Way from the first point to each point [m].
        length: Of the whole line [m].
        period: After which ways along it come back [m]; of an open line more than they are apart.
    """

    def __init__(self, points: Sequence[Point], widths: Sequence[float] = (), closed: bool = True) -> None:
        self.points, self.closed = list(points), closed
        self.widths = list(widths) or [WIDTH] * len(points)
        self.starts = [0.0]
        for before, after in zip(self.points, self.points[1:], strict=False):
            self.starts.append(self.starts[-1] + math.dist(before, after))
        self.length = self.starts[-1]
        self.period = self.length if closed else 2 * self.length

    def on(self, way: float) -> float:
        """A way along the line, which may be more than a lap: from the start, and no farther than the ends of an open line [m]."""
        return way % self.length if self.closed else min(max(way, 0.0), self.length)

    def driven(self, way: float, is_reversed: bool) -> float:
        """A way along the line, in the direction in which a car drives: reversed, from the end of an open line [m]."""
        way = self.on(way)
        if is_reversed:
            return self.on(self.length - way)
        return way

    def width(self, way: float) -> float:
        """Of the road [m]."""
        return self.widths[self.at(way)[0]]

    def at(self, way: float) -> tuple[int, Point, float]:
        """The segment's number, the point and the direction [rad] at a way along the line, which may be more than a lap."""
        way = self.on(way)
        segment = max(index for index, start in enumerate(self.starts[:-1]) if start <= way)
        (x0, y0), (x1, y1) = self.points[segment], self.points[segment + 1]
        share = (way - self.starts[segment]) / max(self.starts[segment + 1] - self.starts[segment], 1e-9)
        return segment, (x0 + share * (x1 - x0), y0 + share * (y1 - y0)), math.atan2(y1 - y0, x1 - x0)

    def project(self, point: Point, is_reversed: bool) -> tuple[int, float, float]:
        """The segment, the way along the line and the distance [m] of the nearest place, as :func:`racer.tracks.geometry.project` has them."""
        import numpy as np  # not at the top: whoever reads a task's settings imports this

        from racer.tracks.arithmetic import nearest

        (row,), (share,) = nearest(np.array(self.points), np.array([point]), closed=False)
        segment, last = int(row), len(self.points) - 2
        if not is_reversed and share >= 1.0 and (self.closed or segment < last):
            segment, share = (segment + 1) % (last + 1), 0.0
        elif is_reversed and share <= 0.0 and (self.closed or segment > 0):
            segment, share = (segment - 1) % (last + 1), 1.0
        (x0, y0), (x1, y1) = self.points[segment : segment + 2]
        way = self.starts[segment] + float(share) * (self.starts[segment + 1] - self.starts[segment])
        return segment, way, math.dist(point, (x0 + share * (x1 - x0), y0 + share * (y1 - y0)))


def oval(straight: float = 4.0, radius: float = 1.6, spacing: float = 0.15) -> list[Point]:
    """Two straights and two half circles, driven to the left; the first point is also the last one [m]."""
    half = math.pi * radius
    length = 2.0 * (straight + half)
    count = round(length / spacing)
    points = []
    for index in range(count):
        way = length * index / count
        side, along = divmod(way, straight + half)
        sign = -1.0 if side else 1.0
        if along < straight:
            x, y = along - straight / 2, -radius
        else:
            angle = (along - straight) / radius - math.pi / 2
            x, y = straight / 2 + radius * math.cos(angle), radius * math.sin(angle)
        points.append((sign * x, sign * y))
    return [*points, points[0]]


def _degrees(angle: float) -> float:
    """An angle [rad] in degrees, from -180 to 180."""
    return (math.degrees(angle) + 180.0) % 360.0 - 180.0


def sample(
    line: CentreLine, car: Placed, objects: Sequence[Placed] = (), *, is_reversed: bool = False, **known: Any
) -> dict[str, Any]:
    """Sample arguments of a reward function.

    Args:
        line: Centre line of the track.
        car: The car.
        objects: What else is there.
        is_reversed: Whether it drives against the line's direction.
        **known: Values of further keys; also of those that follow from the rest.

    Raises:
        KeyError: There is no such key.
    """
    _, (x, y), direction = line.at(car.way)
    points, width = line.points, line.width(car.way)
    if is_reversed:
        points, direction = points[::-1], direction + math.pi
    x, y = x - car.offset * math.sin(direction), y + car.offset * math.cos(direction)
    segment, along, far = line.project((x, y), is_reversed)  # beside a polygon the way to which the car belongs differs
    if is_reversed:
        segment = len(points) - 2 - segment
    if car.offset == 0.0:
        far = 0.0
    left = car.offset > 0.0
    poses = [line.at(each.way) for each in objects]
    way, *others = (
        line.driven(each, is_reversed) for each in (along, *(each.way for each in objects))
    )  # all that follows is in driving direction
    ahead = sorted(range(len(objects)), key=lambda index: (others[index] - way) % line.period)
    params = {
        "all_wheels_on_track": far + _CAR <= width / 2,
        "x": x,
        "y": y,
        "heading": _degrees(direction + math.radians(car.turned)),
        "distance_from_center": far,
        "is_left_of_center": left,
        "is_reversed": is_reversed,
        "is_crashed": False,
        "is_offtrack": far - _CAR > width / 2,
        "progress": 100.0 * way / line.length,
        "steps": 1,
        "speed": car.speed,
        "steering_angle": 0.0,
        "track_length": line.length,
        "track_width": width,
        "closest_waypoints": [segment, segment + 1],
        "closest_objects": [ahead[-1], ahead[0]] if ahead else [0, 0],
        "projection_distance": way,
        "sim_time": 0.0,
        "object_in_camera": any((other - way) % line.period < 2.0 for other in others),
        "waypoints": list(points),
        "objects_location": [
            (px - each.offset * math.sin(angle), py + each.offset * math.cos(angle))
            for each, (_, (px, py), angle) in zip(objects, poses, strict=True)
        ],
        "objects_distance": others,
        "objects_heading": [0.0] * len(objects),
        "objects_left_of_center": [each.offset != 0.0 and (each.offset > 0.0) != is_reversed for each in objects],
        "objects_speed": [each.speed for each in objects],
        "objects_distance_from_center": [abs(each.offset) for each in objects],
    }
    for name, value in known.items():
        if name not in BY_NAME:
            raise KeyError(name)
        params[name] = value
    return {each.name: params[each.name] for each in PARAMETERS}


@dataclass(frozen=True)
class Course:
    """A track of a job with its objects.

    Attributes:
        name: Of the track; empty: it is none of a job's.
        points: As :class:`CentreLine` has them.
        widths: Of the road at each point [m].
        closed: Whether it is a loop.
        objects: On it.
    """

    name: str
    points: tuple[Point, ...]
    widths: tuple[float, ...] = ()
    closed: bool = True
    objects: tuple[Placed, ...] = ()

    @property
    def where(self) -> str:
        """The end of a message: the track; empty where it is none of a job's."""
        waypoints = len(self.points) - self.closed
        return f", on track {self.name} with {waypoints} waypoints" if self.name else ""

    def trials(self) -> list[dict[str, dict[str, Any]]]:
        """Sample inputs with each of which a function may pass: with the job's objects, or without any, and as AWS tries it."""
        if self.objects:
            return [samples(self, self.objects)]
        line = CentreLine(self.points, self.widths, self.closed)
        ways = [line.length * (number + 0.5) / SIX for number in range(SIX)]
        six = [Placed(way, 0.25 * line.width(way) * (-1) ** number) for number, way in enumerate(ways)]
        return [samples(self, () if self.name else None), samples(self, six)]


OVAL = Course("", tuple(oval()))
FINE_OVAL = Course("", tuple(oval(spacing=0.03)))
"""In the place of tracks that are not known: no index of a waypoint that some track has is missing on it."""


def samples(course: Course = OVAL, objects: Sequence[Placed] | None = None) -> dict[str, dict[str, Any]]:
    """Sample inputs by name, with which the guard tries a function.

    Args:
        course: The track.
        objects: On it in all samples; None: three boxes in those in which the car meets some.
    """
    line = CentreLine(course.points, course.widths, course.closed)
    share = line.length / CentreLine(OVAL.points).length

    def car(way: float, offset: float, turned: float, speed: float) -> Placed:
        way *= share
        return Placed(way, offset * line.width(way) / WIDTH, turned, speed)

    boxes = [car(7.0, 0.25, 0, 0), car(11.0, -0.25, 0, 0), car(15.5, 0.25, 0, 0)] if objects is None else objects
    others = objects or ()
    off = car(12.0, 0.0, -55.0, 1.0)
    off = Placed(off.way, -line.width(off.way) / 2 - 0.165, off.turned, off.speed)
    before, at = car(6.4, 0.2, 3.0, 1.8), car(7.0, 0.25, 0.0, 0.5)
    if boxes:
        before = Placed(boxes[0].way - 0.6, before.offset, before.turned, before.speed)
        at = Placed(boxes[0].way, boxes[0].offset, 0.0, 0.5)
    finish = Placed(line.length - 0.01, 0.05, 2.0, 3.9)
    return {
        "start": sample(line, Placed(0.02, 0.0, 0.0, 0.6), others),
        "straight": sample(line, car(1.5, 0.21, -8.0, 2.5), others, steps=40, sim_time=2.6, steering_angle=-12.0),
        "curve": sample(line, car(6.1, -0.31, 15.0, 1.2), others, steps=95, sim_time=6.3, steering_angle=25.0),
        "edge": sample(line, car(9.4, 0.5, 31.0, 3.0), others, steps=150, sim_time=10.0, steering_angle=-30.0),
        "off-track": sample(line, off, others, steps=171, sim_time=11.4, steering_angle=30.0),
        "reversed": sample(line, car(3.3, 0.1, 5.0, 1.5), others, is_reversed=True, steps=60, sim_time=4.0),
        "objects": sample(line, before, boxes, steps=110, sim_time=7.3, steering_angle=10.0),
        "crashed": sample(line, at, boxes, is_crashed=True, steps=120, sim_time=8.0),
        "finish": sample(line, finish, others, progress=100.0, steps=310, sim_time=20.6),
    }


def random_sample(line: CentreLine, chance: random.Random) -> dict[str, Any]:
    """Sample inputs drawn at random: anywhere on the track and beside it, with up to :data:`MOST_OBJECTS` objects.

    Args:
        line: Centre line of the track.
        chance: What draws.
    """

    def placed() -> Placed:
        offset = chance.uniform(-0.75, 0.75)
        return Placed(chance.uniform(0.0, line.length), offset, chance.gauss(0.0, 40.0), chance.uniform(0.1, 4.0))

    objects = [placed() for _ in range(chance.choice((0, 0, 1, 2, 3, MOST_OBJECTS)))]
    steps = chance.randrange(1, 600)
    return sample(
        line,
        placed(),
        objects,
        is_reversed=chance.random() < 0.3,
        steps=steps,
        sim_time=steps / 15.0,
        steering_angle=chance.choice((-30.0, -15.0, 0.0, 15.0, 30.0, chance.uniform(-30.0, 30.0))),
        progress=chance.choice((chance.uniform(0.0, 100.0), 100.0)),
        is_crashed=chance.random() < 0.1,
        objects_heading=[chance.uniform(-180.0, 180.0) for _ in objects],
    )
