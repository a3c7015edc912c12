"""Arguments of a reward function: the keys of ``params``, and the arrays that hold them for all cars in a step.

One table says it all. The dictionaries of the interpreter, the columns of the arrays, the checks and the page of the documentation
follow from it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

MOST_OBJECTS = 10
"""Objects (obstacles and other cars) that a function gets at most."""
Point = tuple[float, float]


@dataclass(frozen=True)
class Parameter:
    """A key of ``params``.

    Attributes:
        name: The key.
        kind: ``bool``, ``int`` or ``float``: what it holds, or what its elements hold.
        shape: ``one`` value; ``two``: a list of two; ``waypoints``: a list of points, constants of the track; ``objects``: a list with
            an element for each object.
        unit: Of its numbers; empty where they have none.
        meaning: One line.
        limits: Least and greatest value; None: no bound.
        points: Whether the elements are points ``(x, y)``.
        documented: Whether AWS documents it; the others are passed by its simulator, too.
    """

    name: str
    kind: str
    shape: str
    unit: str
    meaning: str
    limits: tuple[float | None, float | None] = (None, None)
    points: bool = False
    documented: bool = True

    @property
    def type(self) -> str:
        """The type as a user writes it."""
        if self.shape == "two":
            return "[int, int]"
        element = "(float, float)" if self.points else self.kind
        return element if self.shape == "one" else f"[{element}, …]"

    @property
    def width(self) -> int:
        """Numbers of the value, or of one element of a list of objects or waypoints."""
        return 2 if self.points or self.shape == "two" else 1


PARAMETERS = (
    Parameter("all_wheels_on_track", "bool", "one", "", "Whether all four wheels are on the road"),
    Parameter("x", "float", "one", "m", "Position of the car's front along the x axis"),
    Parameter("y", "float", "one", "m", "Position of the car's front along the y axis"),
    Parameter(
        "heading", "float", "one", "degrees", "Direction of the car, from the x axis to the left", (-180.0, 180.0)
    ),
    Parameter("distance_from_center", "float", "one", "m", "Distance from the centre line", (0.0, None)),
    Parameter("is_left_of_center", "bool", "one", "", "Whether the car is on the left of the centre line"),
    Parameter("is_reversed", "bool", "one", "", "Whether the car drives against the direction of the track"),
    Parameter("is_crashed", "bool", "one", "", "Whether the car has hit an object"),
    Parameter("is_offtrack", "bool", "one", "", "Whether no wheel is on the road"),
    Parameter("progress", "float", "one", "%", "Share of the lap that is done", (None, 100.0)),
    Parameter("steps", "int", "one", "", "Control steps since the episode began", (1, None)),
    Parameter("speed", "float", "one", "m/s", "Speed that the action asks for", (0.0, 5.0)),
    Parameter(
        "steering_angle",
        "float",
        "one",
        "degrees",
        "Steering angle that the action asks for, to the left",
        (-30.0, 30.0),
    ),
    Parameter("track_length", "float", "one", "m", "Length of the centre line", (0.0, None)),
    Parameter("track_width", "float", "one", "m", "Width of the road where the car is", (0.0, None)),
    Parameter(
        "closest_waypoints", "int", "two", "", "Indices of the waypoints behind and in front of the car", (0, None)
    ),
    Parameter(
        "closest_objects",
        "int",
        "two",
        "",
        "Indices of the objects behind and in front of the car; zeros where there is none",
        (0, None),
    ),
    Parameter(
        "projection_distance",
        "float",
        "one",
        "m",
        "Way along the centre line from the start line",
        (0.0, None),
        documented=False,
    ),
    Parameter("sim_time", "float", "one", "s", "Time since the episode began", (0.0, None), documented=False),
    Parameter(
        "object_in_camera", "bool", "one", "", "Whether the next object is in the camera's image", documented=False
    ),
    Parameter("waypoints", "float", "waypoints", "m", "The centre line, a point after the other", points=True),
    Parameter("objects_location", "float", "objects", "m", "Where the objects are", points=True),
    Parameter(
        "objects_distance", "float", "objects", "m", "Way along the centre line to the objects from the start line"
    ),
    Parameter("objects_heading", "float", "objects", "degrees", "Direction of the objects", (-180.0, 180.0)),
    Parameter(
        "objects_left_of_center", "bool", "objects", "", "Whether the objects are on the left of the centre line"
    ),
    Parameter("objects_speed", "float", "objects", "m/s", "Speed of the objects", (0.0, None)),
    Parameter(
        "objects_distance_from_center",
        "float",
        "objects",
        "m",
        "Distance of the objects from the centre line",
        (0.0, None),
        documented=False,
    ),
)
"""Every key, in the order of the arrays' columns."""
BY_NAME: Mapping[str, Parameter] = {each.name: each for each in PARAMETERS}


def _columns(shapes: Sequence[str]) -> dict[str, int]:
    columns, count = dict[str, int](), 0
    for each in PARAMETERS:
        if each.shape in shapes:
            columns[each.name], count = count, count + each.width
    return columns


NUMBER_COLUMNS: Mapping[str, int] = _columns(("one", "two"))
"""First column of each key in ``numbers``, shape ``(worlds, NUMBERS)``, float32: truth values are 0 and 1."""
OBJECT_COUNT = sum(BY_NAME[name].width for name in NUMBER_COLUMNS)
"""Column of ``numbers``: how many objects there are."""
TRACK = OBJECT_COUNT + 1
"""Column of ``numbers``: the row of the car's track in ``waypoints``."""
NUMBERS = TRACK + 1
OBJECT_COLUMNS: Mapping[str, int] = _columns(("objects",))
"""First column of each key in ``objects``, shape ``(worlds, MOST_OBJECTS, OBJECT_NUMBERS)``, float32."""
OBJECT_NUMBERS = sum(BY_NAME[name].width for name in OBJECT_COLUMNS)

_CASTS = {"bool": bool, "int": int, "float": float}


def parameters_of(
    numbers: Sequence[float], objects: Sequence[Sequence[float]], waypoints: Sequence[Point]
) -> dict[str, Any]:
    """The dictionary that a reward function is given; its containers are new, so that a function may change them.

    Args:
        numbers: A car's row, ``NUMBERS`` long.
        objects: Of each of its objects a row, ``OBJECT_NUMBERS`` long; as many as there are.
        waypoints: Of its track [m].
    """
    params: dict[str, Any] = {}
    for each in PARAMETERS:
        cast = _CASTS[each.kind]
        if each.shape == "waypoints":
            params[each.name] = list(waypoints)
        elif each.shape == "objects":
            first = OBJECT_COLUMNS[each.name]
            params[each.name] = [(row[first], row[first + 1]) if each.points else cast(row[first]) for row in objects]
        else:
            first = NUMBER_COLUMNS[each.name]
            params[each.name] = (
                cast(numbers[first]) if each.shape == "one" else [cast(numbers[first]), cast(numbers[first + 1])]
            )
    return params


def row_of(params: Mapping[str, Any], track: int = 0) -> tuple[list[float], list[list[float]]]:
    """A car's row of ``numbers`` and its rows of ``objects``: what :func:`parameters_of` reads.

    Args:
        params: Every key of :data:`PARAMETERS`.
        track: Row of the car's track.

    Raises:
        ValueError: There are more than :data:`MOST_OBJECTS` objects.
    """
    count = len(params["objects_location"])
    if count > MOST_OBJECTS:
        raise ValueError(f"a function gets at most {MOST_OBJECTS} objects, not {count}")
    numbers = [0.0] * NUMBERS
    objects = [[0.0] * OBJECT_NUMBERS for _ in range(count)]
    for name, first in NUMBER_COLUMNS.items():
        value = params[name]
        for place, number in enumerate(value if BY_NAME[name].shape == "two" else [value]):
            numbers[first + place] = float(number)
    for name, first in OBJECT_COLUMNS.items():
        for row, value in zip(objects, params[name], strict=True):
            for place, number in enumerate(value if BY_NAME[name].points else [value]):
                row[first + place] = float(number)
    numbers[OBJECT_COUNT], numbers[TRACK] = float(count), float(track)
    return numbers, objects
