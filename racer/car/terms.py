"""The terms of the racer's tasks: what a policy sees of the road, what it earns, when an episode ends, where one begins."""

from __future__ import annotations

import warp as wp

from racer.car.car_arrays import (
    STEERING,
    WHEELS,
    CarArrays,
    ahead_of,
    from_car,
    gap_to,
    lap_of,
    progress_of,
    put_car,
)
from racer.tracks.road import place_at, start_at
from worker.simulation.episodes import EpisodeArrays
from worker.simulation.kinematics import wrapped_angle
from worker.simulation.robot_arrays import RobotArrays
from worker.simulation.worlds import WorldArrays

wp.set_module_options({"enable_backward": False})

STARTS = ("line", "round_robin", "random")
"""Starting places of an episode, by the number that :func:`place_car` receives."""
ROUND_ROBIN = wp.constant(STARTS.index("round_robin"))
RANDOM = wp.constant(STARTS.index("random"))
GRAVITY = wp.constant(9.81)
"""[m/s²]"""
UNSEEN = wp.constant(4.0)
"""An obstacle farther ahead than this is not seen [m]."""
STARTED = wp.constant(0.5)
"""The front of a car that begins an open track at its start is behind the line by less than this [m]."""


@wp.func
def choose(world: int, worlds: WorldArrays, robot: RobotArrays, car: CarArrays, choice: int):
    """Ask for the steering and the speed of a choice."""
    target = car.choices[wp.clamp(choice, 0, car.choices.shape[0] - 1)]
    worlds.controls[world, robot.actuators[STEERING]] = target[0]
    worlds.controls[world, robot.actuators[WHEELS]] = target[1]


@wp.func
def waypoint_ahead(world: int, car: CarArrays, index: int, spacing: float) -> wp.vec2:
    """A point of the centre line ``spacing`` * (``index`` + 1) [m] ahead along it, as the car's front sees it: ahead, left [m]."""
    along = car.along[world] + spacing * float(index + 1)
    place = place_at(car.road, car.tracks[world], along, car.backwards[world])
    return from_car(car.poses[world], wp.vec2(place[0], place[1]))


@wp.func
def lateral_error(world: int, car: CarArrays) -> float:
    """Distance of the front to the left of the centre line [m]."""
    side = car.distances[world]
    if not car.left[world]:
        side = -side
    return side


@wp.func
def heading_error(world: int, car: CarArrays) -> float:
    """By how much the car points to the left of the centre line [rad], from -pi to pi."""
    return wrapped_angle(car.poses[world][2] - car.headings[world])


@wp.func
def car_speed(world: int, car: CarArrays) -> float:
    """[m/s]."""
    return car.speeds[world]


@wp.func
def car_steering(world: int, car: CarArrays) -> float:
    """Of the front wheels [rad]."""
    return car.steerings[world]


@wp.func
def road_width(world: int, car: CarArrays) -> float:
    """Of the road beside the car [m]."""
    return car.widths[world]


@wp.func
def obstacle_ahead(world: int, car: CarArrays) -> wp.vec2:
    """The next obstacle as the car's front sees it: ahead, left [m]; (4, 0) where none is within 4 m along the centre line."""
    number = car.next_obstacle[world]
    track = car.tracks[world]
    seen = wp.vec2(UNSEEN, 0.0)
    if number >= 0 and gap_to(world, car, number) < UNSEEN:
        pose = car.obstacle_poses[track, number]
        seen = from_car(car.poses[world], wp.vec2(pose[0], pose[1]))
    return seen


@wp.func
def progress_made(world: int, car: CarArrays) -> float:
    """Progress of the car in this step, as a share of the track [%]; negative where it drove back or was put back."""
    return 100.0 * (car.moved[world] - car.set_back[world]) / car.road.length[car.tracks[world]]


@wp.func
def left_road(world: int, car: CarArrays) -> bool:
    """No wheel is on the road."""
    return car.wheels[world] == 0


@wp.func
def hit_obstacle(world: int, car: CarArrays) -> bool:
    """The car touches an obstacle."""
    return car.crashed[world]


@wp.func
def ends_crashed(world: int, car: CarArrays) -> bool:
    """The car touches an obstacle, and is not put back."""
    return car.crashed[world] and not car.put[world]


@wp.func
def ends_off_track(world: int, car: CarArrays) -> bool:
    """No wheel is on the road, and the car is not put back."""
    return car.wheels[world] == 0 and not car.put[world]


@wp.func
def lap_complete(world: int, car: CarArrays) -> bool:
    """The car has come as far as the track is long since the episode began, or to the end of an open track."""
    return progress_of(world, car) >= 100.0


@wp.func
def immobilized(world: int, car: CarArrays, steps: int) -> bool:
    """The car moved by less than 0.3 mm in each of the last ``steps``, and is not put back."""
    return car.standing[world] >= steps and not car.put[world]


@wp.func
def reversed_course(world: int, car: CarArrays, steps: int) -> bool:
    """The car came back in each of the last ``steps``, and is not put back."""
    return car.falling[world] >= steps and not car.put[world]


@wp.func
def final_progress(world: int, car: CarArrays) -> float:
    """Share of a lap that the car has driven since the episode began [%], less the losses from being put back."""
    return 100.0 * wp.clamp((car.travelled[world] - car.set_back[world]) / lap_of(world, car), 0.0, 1.0)


@wp.func
def lap_time(world: int, car: CarArrays, seconds: float) -> float:
    """Duration of a lap [s]; 0 for an incomplete one, and on an open track for one that did not begin at its start."""
    time = float(0.0)
    whole = lap_of(world, car) >= car.road.length[car.tracks[world]] - STARTED
    if progress_of(world, car) >= 100.0 and whole:
        time = float(car.steps[world]) * seconds
    return time


@wp.func
def place_car(
    world: int,
    worlds: WorldArrays,
    episodes: EpisodeArrays,
    robot: RobotArrays,
    car: CarArrays,
    stream: wp.uint32,
    lasting: int,
    start: int,
    step: float,
    alternate: bool,
    sideways: wp.vec2,
    turned: wp.vec2,
    speed_factor: wp.vec2,
    steering_factor: wp.vec2,
    steering_offset: wp.vec2,
    friction: wp.vec2,
):
    """Put the car on the centre line of its track, at rest, and draw how well it obeys in this episode.

    Args:
        start: An index into :data:`STARTS`: at the start line, ``step`` of the track on from episode to episode and world to world, or
            anywhere.
        step: A share of the track.
        alternate: Whether every other episode drives against the order of the waypoints.
        sideways: Least and greatest distance to the left of the centre line [m].
        turned: Least and greatest angle to the left of its heading [rad].
        speed_factor: Least and greatest factor on the speed that is asked.
        steering_factor: Least and greatest factor on the steering that is asked.
        steering_offset: Least and greatest angle that is added to it [rad].
        friction: Least and greatest coefficient of friction between tyres and road; 0: they never slide.
    """
    episode = int(episodes.lasting[world, lasting])
    tracks = car.road.first.shape[0]
    # counted up to a million, as float32 can; the starts go on from there as from 0
    episodes.lasting[world, lasting] = float((episode + 1) % 1000000)
    number = episodes.random[world, 1]
    track = number % tracks
    backwards = alternate and episode % 2 == 1
    share, drawn = float(0.0), wp.randf(stream)
    if start == ROUND_ROBIN:
        share = step * float((number / tracks + episode) % 1000000)
    if start == RANDOM:
        share = drawn
    share = share - wp.floor(share)
    place = place_at(car.road, track, start_at(car.road, track, share), backwards)
    point = ahead_of(place, 0.0, wp.randf(stream, sideways[0], sideways[1]))
    heading = wrapped_angle(place[2] + wp.randf(stream, turned[0], turned[1]))
    car.tracks[world] = track
    car.backwards[world] = backwards
    car.poses[world] = wp.vec3(point[0], point[1], heading)
    car.speeds[world] = 0.0
    car.steerings[world] = 0.0
    car.factors[world] = wp.vec4(
        wp.randf(stream, speed_factor[0], speed_factor[1]),
        wp.randf(stream, steering_factor[0], steering_factor[1]),
        wp.randf(stream, steering_offset[0], steering_offset[1]),
        GRAVITY * wp.randf(stream, friction[0], friction[1]),
    )
    put_car(world, worlds, robot, car)
