"""Resets of cars: what went wrong in a control step, where the car is put back, and how often that happened in its episode."""

from __future__ import annotations

import warp as wp

from racer.car.car_arrays import (
    FRONT,
    HALF_LENGTH,
    HALF_WIDTH,
    STEERING,
    STEERING_RIGHT,
    WHEELS,
    CarArrays,
    X,
    Y,
    ahead_of,
    locate_car,
    overlap,
    progress_of,
    put_car,
)
from racer.car.car_arrays import HEADING as HEADING_JOINT
from racer.tracks.road import FIRST_PLACE, advance, is_open, place_at, project, width_at
from worker.simulation.robot_arrays import RobotArrays
from worker.simulation.worlds import WorldArrays

wp.set_module_options({"enable_backward": False})

INCIDENTS = ("crashed", "off_track", "immobilized", "reversed")
"""Incidents, by the name of their termination; number n is n + 1 in ``CarArrays.incidents``. Of several at once the first one counts."""
COUNTS = (*INCIDENTS, "resets")
"""Counters of an episode: the columns of ``CarArrays.counts``."""
CRASHED, OFF_TRACK, IMMOBILIZED, REVERSED = (wp.constant(number + 1) for number in range(len(INCIDENTS)))
RESETS = wp.constant(COUNTS.index("resets"))


@wp.func
def note_incident(world: int, car: CarArrays):
    """After a control step: count what went wrong, and find where the car is to be put, if it is. A lap that is complete stays so."""
    incident = int(0)  # noqa: RUF046 (a variable for Warp, not a constant)
    if car.falling[world] >= car.rules.stuck_steps:
        incident = REVERSED
    if car.standing[world] >= car.rules.stuck_steps:
        incident = IMMOBILIZED
    if car.wheels[world] == 0:
        incident = OFF_TRACK
    if car.crashed[world]:
        incident = CRASHED
    if progress_of(world, car) >= 100.0:
        incident = 0
    car.incidents[world] = incident
    car.set_back[world] = 0.0
    put = bool(False)
    if incident > 0:
        car.counts[world, incident - 1] = car.counts[world, incident - 1] + 1
        put = car.rules.continuous and car.counts[world, RESETS] < car.rules.max_resets
    car.put[world] = put
    if put:
        car.counts[world, RESETS] = car.counts[world, RESETS] + 1
        find_place(world, car)


@wp.func
def find_place(world: int, car: CarArrays):
    """Finds the place where a car is put down: its front is ``put_back`` behind its last place.

    It stands on the centre line, or beside it where a box is in the way.

    The lanes are the centre line, the middle of that half of the road on which the front was, and that of the other half; the first one
    is taken that is clear, and the centre line where none is.
    """
    track = car.tracks[world]
    backwards = car.backwards[world]
    behind = car.along[world] - car.rules.put_back - FRONT
    if is_open(car.road, track):
        behind = wp.max(behind, FIRST_PLACE)
    place = place_at(car.road, track, behind, backwards)
    beside = 0.25 * width_at(car.road, track, behind, backwards)
    if not car.left[world]:
        beside = -beside
    sideward = float(0.0)
    if not is_clear(world, car, place):
        if is_clear(world, car, moved_aside(place, beside)):
            sideward = beside
        elif is_clear(world, car, moved_aside(place, -beside)):
            sideward = -beside
    pose = moved_aside(place, sideward)
    car.put_poses[world] = pose
    front = ahead_of(pose, FRONT, 0.0)
    found = project(car.road, track, front, backwards, 0, car.road.count[track])
    car.set_back[world] = -advance(car.road, track, car.along[world], found.along)


@wp.func
def moved_aside(pose: wp.vec3, sideward: float) -> wp.vec3:
    """The pose so far to its left [m]."""
    point = ahead_of(pose, 0.0, sideward)
    return wp.vec3(point[0], point[1], pose[2])


@wp.func
def is_clear(world: int, car: CarArrays, pose: wp.vec3) -> bool:
    """Whether a car there touches no box, nor would if it drove straight on for ``put_back`` and a car's length."""
    reach = 0.5 * car.rules.put_back + HALF_LENGTH
    middle = ahead_of(pose, reach, 0.0)
    lane = wp.vec3(middle[0], middle[1], pose[2])
    half = wp.vec2(HALF_LENGTH + reach, HALF_WIDTH)
    clear = bool(True)
    for number in range(car.obstacle_poses.shape[1]):
        if overlap(lane, half, car.obstacle_poses[car.tracks[world], number], car.obstacle_half):
            clear = False
    return clear


@wp.func
def put_back(world: int, worlds: WorldArrays, robot: RobotArrays, car: CarArrays):
    """Put a car back that is to be, at rest."""
    if car.put[world]:
        car.poses[world] = car.put_poses[world]
        car.speeds[world] = 0.0
        car.steerings[world] = 0.0
        put_car(world, worlds, robot, car)
        worlds.joint_qd[world, robot.dofs[X]] = 0.0
        worlds.joint_qd[world, robot.dofs[Y]] = 0.0
        worlds.joint_qd[world, robot.dofs[HEADING_JOINT]] = 0.0
        worlds.joint_qd[world, robot.dofs[STEERING]] = 0.0
        worlds.joint_qd[world, robot.dofs[STEERING_RIGHT]] = 0.0
        worlds.joint_qd[world, robot.dofs[WHEELS]] = 0.0


@wp.func
def go_on(world: int, car: CarArrays):
    """Updates the progress of a car that was put back: it loses the distance that it has to drive again."""
    locate_car(world, car, 0, car.road.count[car.tracks[world]])
    car.commands[world] = wp.vec2(0.0, 0.0)
    car.travelled[world] = car.travelled[world] - car.set_back[world]
    car.moved[world] = 0.0
    car.standing[world] = 0
    car.falling[world] = 0


@wp.func
def forget_incidents(world: int, car: CarArrays):
    """Resets the counters at the beginning of an episode."""
    car.incidents[world] = 0
    car.put[world] = False
    car.set_back[world] = 0.0
    for column in range(car.counts.shape[1]):
        car.counts[world, column] = 0


@wp.func
def happened(world: int, car: CarArrays, column: int) -> float:
    """A count of the episode so far, by its column in :data:`COUNTS`."""
    return float(car.counts[world, column])


@wp.func
def penalty(world: int, car: CarArrays, off_track: float, crash: float) -> float:
    """Penalties of the episode so far [s].

    Args:
        off_track: For each time that the car left the road [s].
        crash: For each obstacle that it touched [s].
    """
    return off_track * happened(world, car, OFF_TRACK - 1) + crash * happened(world, car, CRASHED - 1)
