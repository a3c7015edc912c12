"""The trace of a control step: values for race results and SimTrace files, noted on the device before an ended episode begins anew."""

from __future__ import annotations

import warp as wp

from racer.car.car_arrays import CarArrays, progress_of
from racer.car.resets import COUNTS
from racer.tracks.road import next_row

wp.set_module_options({"enable_backward": False})

COLUMNS = (
    *("x", "y", "heading", "steering", "speed", "wheels", "progress", "waypoint"),
    *COUNTS,
)
"""Of ``CarArrays.trace``: the front [m] and its heading [rad]; steering [rad] and speed [m/s] that reached the car; how many wheels are on
the road; progress [%]; the nearer one of the closest waypoints; the counts of the episode so far."""
FIRST_COUNT = wp.constant(COLUMNS.index(COUNTS[0]))


@wp.func
def trace_car(world: int, car: CarArrays):
    """Note a control step."""
    front = car.fronts[world]
    command = car.commands[world]
    track = car.tracks[world]
    first = car.road.first[track]
    behind = wp.length(front - car.road.center[first + car.rows[world]])
    ahead = wp.length(front - car.road.center[first + next_row(car.road, track, car.rows[world])])
    waypoint = car.before[world]
    if (not car.backwards[world] and ahead < behind) or (car.backwards[world] and behind < ahead):
        waypoint = car.after[world]
    car.trace[world, 0] = front[0]
    car.trace[world, 1] = front[1]
    car.trace[world, 2] = car.poses[world][2]
    car.trace[world, 3] = command[0]
    car.trace[world, 4] = command[1]
    car.trace[world, 5] = float(car.wheels[world])
    car.trace[world, 6] = progress_of(world, car)
    car.trace[world, 7] = float(waypoint)
    for column in range(car.counts.shape[1]):
        car.trace[world, FIRST_COUNT + column] = float(car.counts[world, column])
