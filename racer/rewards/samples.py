"""Sample inputs of reward functions: cars, and objects, placed on the tracks of a job, or on an oval.

NumPy is imported where it is used: reading a task's settings imports this module.
"""

from __future__ import annotations

import functools
import math
import random
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from racer.rewards.parameters import BY_NAME, MOST_OBJECTS, PARAMETERS, Point

if TYPE_CHECKING:
    from racer.tracks.race_track import Track

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


@functools.cache
def oval_track(spacing: float = 0.15) -> Track:
    """The oval, with so much between its waypoints [m]."""
    from racer.tracks.presets import make_preset

    return make_preset("oval", length=18.06, width=WIDTH, spacing=spacing)


def oval() -> list[Point]:
    """Its waypoints; the first point is also the last one [m]."""
    return [*map(tuple, oval_track().line().tolist())]


def sample(
    track: Track, car: Placed, objects: Sequence[Placed] = (), *, is_reversed: bool = False, **known: Any
) -> dict[str, Any]:
    """Sample arguments of a reward function.

    Args:
        track: The track.
        car: The car.
        objects: What else is on it.
        is_reversed: Whether the car drives against the line's direction.
        **known: Values of further keys; also of those that follow from the rest.

    Raises:
        KeyError: There is no such key.
    """
    import numpy as np

    from racer.tracks.geometry import place_at, project

    places, directions = place_at(track, [car.way, *(each.way for each in objects)])
    directions[0] += math.pi * is_reversed
    offsets = np.array([car.offset, *(each.offset for each in objects)])
    places += offsets[:, None] * np.stack((-np.sin(directions), np.cos(directions)), -1)
    found = project(track, places[:1], is_reversed)  # beside a polygon the way to which the car belongs differs
    way, width = found.along.item(), found.width.item()
    far = found.distance.item() if car.offset else 0.0
    others = np.array([each.way for each in objects])
    others = track.length - others if is_reversed else others  # all that follows is in driving direction
    others = (np.mod(others, track.length) if track.closed else np.clip(others, 0.0, track.length)).tolist()
    # what is behind on an open track is farther than all that is ahead
    gaps = [(other - way) % (track.length if track.closed else 2 * track.length) for other in others]
    ahead = sorted(range(len(gaps)), key=gaps.__getitem__)
    (x, y), *locations = map(tuple, places.tolist())
    params = {
        "all_wheels_on_track": far + _CAR <= width / 2,
        "x": x,
        "y": y,
        "heading": (math.degrees(directions[0]) + car.turned + 180.0) % 360.0 - 180.0,
        "distance_from_center": far,
        "is_left_of_center": car.offset > 0.0,
        "is_reversed": is_reversed,
        "is_crashed": False,
        "is_offtrack": far - _CAR > width / 2,
        "progress": found.progress.item(),
        "steps": 1,
        "speed": car.speed,
        "steering_angle": 0.0,
        "track_length": track.length,
        "track_width": width,
        "closest_waypoints": [found.before.item(), found.after.item()],
        "closest_objects": [ahead[-1], ahead[0]] if ahead else [0, 0],
        "projection_distance": way,
        "sim_time": 0.0,
        "object_in_camera": any(gap < 2.0 for gap in gaps),
        "waypoints": [*map(tuple, track.line()[:: -1 if is_reversed else 1].tolist())],
        "objects_location": locations,
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
        name: Of the track; empty: it is the oval, not a job's.
        objects: On it.
        digest: Of the track: courses with the same one are equal.
        spacing: Between the waypoints of the oval [m].
        of_job: The track; None: the oval.
    """

    name: str = ""
    objects: tuple[Placed, ...] = ()
    digest: str = ""
    spacing: float = 0.15
    of_job: Track | None = field(default=None, compare=False, repr=False)

    @property
    def track(self) -> Track:
        """The track."""
        return self.of_job or oval_track(self.spacing)

    @property
    def where(self) -> str:
        """The end of a message: the track; empty where it is not a job's."""
        return f", on track {self.name} with {len(self.track.center)} waypoints" if self.name else ""

    def trials(self) -> list[dict[str, dict[str, Any]]]:
        """Sample inputs with each of which a function may pass: with the job's objects, or without any, and as AWS tries it."""
        if self.objects:
            return [samples(self, self.objects)]
        ways = [self.track.length * (number + 0.5) / SIX for number in range(SIX)]
        six = [Placed(way, 0.25 * _width(self.track, way) * (-1) ** number) for number, way in enumerate(ways)]
        return [samples(self, () if self.name else None), samples(self, six)]


OVAL = Course()
FINE_OVAL = Course(spacing=0.03)
"""In the place of tracks that are not known: no index of a waypoint that some track has is missing on it."""


def _width(track: Track, way: float) -> float:
    """Of the road at a way along its centre line [m]."""
    from racer.tracks.geometry import place_at, project

    return project(track, place_at(track, [way])[0]).width.item()


def samples(course: Course = OVAL, objects: Sequence[Placed] | None = None) -> dict[str, dict[str, Any]]:
    """Sample inputs by name, with which the guard tries a function.

    Args:
        course: The track.
        objects: On it in all samples; None: three boxes in those in which the car meets some.
    """
    track = course.track
    share = track.length / oval_track().length

    def car(way: float, offset: float, turned: float, speed: float) -> Placed:
        way *= share
        return Placed(way, offset * _width(track, way) / WIDTH, turned, speed)

    boxes = [car(7.0, 0.25, 0, 0), car(11.0, -0.25, 0, 0), car(15.5, 0.25, 0, 0)] if objects is None else objects
    others = objects or ()
    off = car(12.0, 0.0, -55.0, 1.0)
    off = Placed(off.way, -_width(track, off.way) / 2 - 0.165, off.turned, off.speed)
    before, at = car(6.4, 0.2, 3.0, 1.8), car(7.0, 0.25, 0.0, 0.5)
    if boxes:
        before = Placed(boxes[0].way - 0.6, before.offset, before.turned, before.speed)
        at = Placed(boxes[0].way, boxes[0].offset, 0.0, 0.5)
    finish = Placed(track.length - 0.01, 0.05, 2.0, 3.9)
    return {
        "start": sample(track, Placed(0.02, 0.0, 0.0, 0.6), others),
        "straight": sample(track, car(1.5, 0.21, -8.0, 2.5), others, steps=40, sim_time=2.6, steering_angle=-12.0),
        "curve": sample(track, car(6.1, -0.31, 15.0, 1.2), others, steps=95, sim_time=6.3, steering_angle=25.0),
        "edge": sample(track, car(9.4, 0.5, 31.0, 3.0), others, steps=150, sim_time=10.0, steering_angle=-30.0),
        "off-track": sample(track, off, others, steps=171, sim_time=11.4, steering_angle=30.0),
        "reversed": sample(track, car(3.3, 0.1, 5.0, 1.5), others, is_reversed=True, steps=60, sim_time=4.0),
        "objects": sample(track, before, boxes, steps=110, sim_time=7.3, steering_angle=10.0),
        "crashed": sample(track, at, boxes, is_crashed=True, steps=120, sim_time=8.0),
        "finish": sample(track, finish, others, progress=100.0, steps=310, sim_time=20.6),
    }


def random_sample(track: Track, chance: random.Random) -> dict[str, Any]:
    """Sample inputs drawn at random: anywhere on the track and beside it, with up to :data:`MOST_OBJECTS` objects.

    Args:
        track: The track.
        chance: What draws.
    """

    def placed() -> Placed:
        offset = chance.uniform(-0.75, 0.75)
        return Placed(chance.uniform(0.0, track.length), offset, chance.gauss(0.0, 40.0), chance.uniform(0.1, 4.0))

    objects = [placed() for _ in range(chance.choice((0, 0, 1, 2, 3, MOST_OBJECTS)))]
    steps = chance.randrange(1, 600)
    return sample(
        track,
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
