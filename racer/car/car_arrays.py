"""Arrays with the state of every world's car, and the Warp functions that fill them in: motion, place on the track, ends, obstacles."""

from __future__ import annotations

import warp as wp

from racer.car.bicycle import WHEELBASE, CarMotion, drive
from racer.tracks.road import RoadArrays, advance, around, is_open, on_road, project
from worker.simulation.kinematics import wrapped_angle
from worker.simulation.robot_arrays import RobotArrays
from worker.simulation.worlds import WorldArrays

wp.set_module_options({"enable_backward": False})

GAUGE = wp.constant(0.16)
"""Between the wheels of an axle [m]."""
FRONT = wp.constant(0.14)
"""The car's front is so far ahead of its middle [m]: the point that reward functions know as x and y."""
HALF_LENGTH = wp.constant(0.14)
HALF_WIDTH = wp.constant(0.1)
"""Half of the rectangle that hits obstacles [m]."""
WHEEL_RADIUS = wp.constant(0.035)
"""[m]."""
LEAST_MOVE = wp.constant(3.0e-4)
"""A car that moves less in a control step stands [m]."""
X, Y, HEADING, STEERING, STEERING_RIGHT, WHEELS = (wp.constant(joint) for joint in range(6))
"""The joints of the car, in the order of its file."""


@wp.struct
class ResetRules:
    """Conditions and place of putting a car back.

    Attributes:
        continuous: Whether it is put back at all; else its episode ends.
        put_back: How far behind where it was [m].
        max_resets: How often in an episode.
        stuck_steps: Control steps in a row of standing, or of coming back, after which it does not go on.
    """

    continuous: bool
    put_back: float
    max_resets: int
    stuck_steps: int


@wp.struct
class CarArrays:
    """The cars, one row a world, and the road that they share. A car drives the track ``tracks[world]``, in that track's own frame.

    Everything below ``places`` is what it was after the last control step, or where an episode begins.

    Attributes:
        road: All tracks.
        choices: Steering [rad] and speed [m/s] of each choice, shape ``(choices,)``; empty where actions are continuous.
        obstacle_poses: Of each track's obstacles: x, y [m] and heading [rad], shape ``(tracks, obstacles)``.
        obstacle_along: From the start line to each in the order of the waypoints [m], shape ``(tracks, obstacles)``.
        obstacle_half: Half the length and half the width of an obstacle [m].
        tracks: Which track, shape ``(worlds,)``.
        backwards: Whether it is driven against the order of the waypoints, shape ``(worlds,)``.
        poses: x and y of the car's middle [m], heading [rad], shape ``(worlds,)``.
        speeds: [m/s], shape ``(worlds,)``.
        steerings: [rad], shape ``(worlds,)``.
        factors: By which this episode's speed and steering miss what is asked, what is added to the steering [rad], and the greatest lateral
            acceleration [m/s²], 0: any; ``(worlds,)``.
        commands: Steering [rad] and speed [m/s] that reached the car last, shape ``(worlds,)``.
        fronts: x and y of the front [m], shape ``(worlds,)``; what follows is of this point.
        rows: The nearest segment of the centre line, shape ``(worlds,)``.
        before: The waypoint behind, counted from the start line in driving direction, shape ``(worlds,)``.
        after: The waypoint ahead, ``before`` + 1, shape ``(worlds,)``; with ``before``, the closest waypoints of reward functions.
        distances: From the centre line [m], shape ``(worlds,)``.
        left: Whether the front is left of it, in driving direction, shape ``(worlds,)``.
        along: From the start line in driving direction [m], shape ``(worlds,)``.
        headings: Of the centre line [rad], shape ``(worlds,)``.
        widths: Of the road [m], shape ``(worlds,)``.
        wheels: How many wheels are on the road, 0 to 4, shape ``(worlds,)``.
        crashed: Whether the car touches an obstacle, shape ``(worlds,)``.
        travelled: Along the centre line since the episode began [m], shape ``(worlds,)``.
        moved: The part of it of the last control step [m], shape ``(worlds,)``.
        steps: Control steps since the episode began, shape ``(worlds,)``.
        standing: Steps in a row in which the car stood, shape ``(worlds,)``.
        falling: Steps in a row in which it came back, shape ``(worlds,)``.
        next_obstacle: Index of the first obstacle ahead; -1: there is none, shape ``(worlds,)``.
        last_obstacle: Index of the first one behind; -1: there is none, shape ``(worlds,)``.
        rules: When cars are put back.
        incidents: What went wrong in the last control step, see :data:`racer.car.resets.INCIDENTS`; 0: nothing, shape ``(worlds,)``.
        put: Whether the car is put back for it, shape ``(worlds,)``.
        put_poses: Where to, where ``put``: as ``poses``, shape ``(worlds,)``.
        set_back: How much of its way along the centre line it loses by that [m], shape ``(worlds,)``.
        counts: How often what happened in the episode, see :data:`racer.car.resets.COUNTS`; shape ``(worlds, 5)``.
        trace: The last control step as race results have it, see :data:`racer.car.trace.COLUMNS`; shape ``(traced, 13)``: of the
            first cars, as many as were asked for.
    """

    road: RoadArrays
    choices: wp.array[wp.vec2]
    obstacle_poses: wp.array2d[wp.vec3]
    obstacle_along: wp.array2d[wp.float32]
    obstacle_half: wp.vec2
    tracks: wp.array[wp.int32]
    backwards: wp.array[wp.bool]
    poses: wp.array[wp.vec3]
    speeds: wp.array[wp.float32]
    steerings: wp.array[wp.float32]
    factors: wp.array[wp.vec4]
    commands: wp.array[wp.vec2]
    fronts: wp.array[wp.vec2]
    rows: wp.array[wp.int32]
    before: wp.array[wp.int32]
    after: wp.array[wp.int32]
    distances: wp.array[wp.float32]
    left: wp.array[wp.bool]
    along: wp.array[wp.float32]
    headings: wp.array[wp.float32]
    widths: wp.array[wp.float32]
    wheels: wp.array[wp.int32]
    crashed: wp.array[wp.bool]
    travelled: wp.array[wp.float32]
    moved: wp.array[wp.float32]
    steps: wp.array[wp.int32]
    standing: wp.array[wp.int32]
    falling: wp.array[wp.int32]
    next_obstacle: wp.array[wp.int32]
    last_obstacle: wp.array[wp.int32]
    rules: ResetRules
    incidents: wp.array[wp.int32]
    put: wp.array[wp.bool]
    put_poses: wp.array[wp.vec3]
    set_back: wp.array[wp.float32]
    counts: wp.array2d[wp.int32]
    trace: wp.array2d[wp.float32]


@wp.func
def ahead_of(pose: wp.vec3, forward: float, sideward: float) -> wp.vec2:
    """The point ``forward`` [m] before and ``sideward`` [m] to the left of a pose."""
    cosine = wp.cos(pose[2])
    sine = wp.sin(pose[2])
    return wp.vec2(pose[0] + forward * cosine - sideward * sine, pose[1] + forward * sine + sideward * cosine)


@wp.func
def from_car(pose: wp.vec3, point: wp.vec2) -> wp.vec2:
    """A point as the car sees it from its front: how far ahead and how far to the left [m]."""
    offset = point - ahead_of(pose, FRONT, 0.0)
    cosine = wp.cos(pose[2])
    sine = wp.sin(pose[2])
    return wp.vec2(offset[0] * cosine + offset[1] * sine, offset[1] * cosine - offset[0] * sine)


@wp.func
def put_car(world: int, worlds: WorldArrays, robot: RobotArrays, car: CarArrays):
    """Set a world's joints to its car's pose."""
    pose = car.poses[world]
    corner = car.road.corner[car.tracks[world]]
    worlds.joint_q[world, robot.coordinates[X]] = corner[0] + pose[0]
    worlds.joint_q[world, robot.coordinates[Y]] = corner[1] + pose[1]
    worlds.joint_q[world, robot.coordinates[HEADING]] = pose[2]
    worlds.joint_q[world, robot.coordinates[STEERING]] = car.steerings[world]
    worlds.joint_q[world, robot.coordinates[STEERING_RIGHT]] = car.steerings[world]


@wp.func
def move_car(
    world: int,
    worlds: WorldArrays,
    robot: RobotArrays,
    car: CarArrays,
    speed_lag: float,
    steering_lag: float,
    seconds: float,
    parts: int,
):
    """One control step of a car, with what its actuators are asked; joints and their velocities follow."""
    steering = worlds.controls[world, robot.actuators[STEERING]]
    speed = worlds.controls[world, robot.actuators[WHEELS]]
    car.commands[world] = wp.vec2(steering, speed)
    pose = car.poses[world]
    factors = car.factors[world]
    rear = ahead_of(pose, -0.5 * WHEELBASE, 0.0)
    motion = CarMotion()
    motion.x = rear[0]
    motion.y = rear[1]
    motion.heading = pose[2]
    motion.speed = car.speeds[world]
    motion.steering = car.steerings[world]
    motion = drive(
        motion,
        factors[0] * speed,
        factors[1] * steering + factors[2],
        factors[3],
        speed_lag,
        steering_lag,
        seconds,
        parts,
    )
    turned = motion.heading - pose[2]
    middle = ahead_of(wp.vec3(motion.x, motion.y, motion.heading), 0.5 * WHEELBASE, 0.0)
    car.poses[world] = wp.vec3(middle[0], middle[1], wrapped_angle(motion.heading))
    car.speeds[world] = motion.speed
    car.steerings[world] = motion.steering
    put_car(world, worlds, robot, car)
    worlds.joint_qd[world, robot.dofs[X]] = (middle[0] - pose[0]) / seconds
    worlds.joint_qd[world, robot.dofs[Y]] = (middle[1] - pose[1]) / seconds
    worlds.joint_qd[world, robot.dofs[HEADING]] = turned / seconds
    rolling = motion.speed / WHEEL_RADIUS
    wheels = robot.coordinates[WHEELS]
    worlds.joint_qd[world, robot.dofs[WHEELS]] = rolling
    worlds.joint_q[world, wheels] = wrapped_angle(worlds.joint_q[world, wheels] + seconds * rolling)


@wp.func
def wheels_on_road(car: CarArrays, track: int, pose: wp.vec3) -> int:
    """Number of wheels, of four, between the borders. The caller knows that not all of them are near the centre line."""
    found = int(0)  # noqa: RUF046 (a variable for Warp, not a constant)
    for wheel in range(4):
        forward, sideward = 0.5 * WHEELBASE, 0.5 * GAUGE
        if wheel > 1:
            forward = -forward
        if wheel % 2 == 1:
            sideward = -sideward
        if on_road(car.road, track, ahead_of(pose, forward, sideward)):
            found += 1
    return found


@wp.func
def reaches(pose: wp.vec3, half: wp.vec2, axis: float) -> float:
    """Half of the shadow of a rectangle on a line in the direction ``axis`` [rad]."""
    turn = pose[2] - axis
    return half[0] * wp.abs(wp.cos(turn)) + half[1] * wp.abs(wp.sin(turn))


@wp.func
def overlap(first: wp.vec3, first_half: wp.vec2, second: wp.vec3, second_half: wp.vec2) -> bool:
    """Whether two rectangles touch: their shadows do on the lines along all of their sides."""
    apart = bool(False)
    for side in range(4):
        axis = first[2] + 0.5 * wp.pi * float(side)
        if side > 1:
            axis = second[2] + 0.5 * wp.pi * float(side)
        between = wp.abs((second[0] - first[0]) * wp.cos(axis) + (second[1] - first[1]) * wp.sin(axis))
        if between > reaches(first, first_half, axis) + reaches(second, second_half, axis):
            apart = True
    return not apart


@wp.func
def locate_car(world: int, car: CarArrays, begin: int, many: int):
    """Locate the car on its track; the nearest segment is one of ``many`` from row ``begin`` on."""
    track = car.tracks[world]
    pose = car.poses[world]
    road = car.road
    front = ahead_of(pose, FRONT, 0.0)
    place = project(road, track, front, car.backwards[world], begin, many)
    car.fronts[world] = front
    car.rows[world] = place.row
    car.before[world] = place.before
    car.after[world] = place.after
    car.distances[world] = place.distance
    car.left[world] = place.left
    car.along[world] = place.along
    car.headings[world] = place.heading
    car.widths[world] = place.width
    wheels = int(4)  # noqa: RUF046 (a variable for Warp, not a constant)
    # no wheel is farther from the front than the rear ones; behind the end of an open track nothing is off the road
    at_end = is_open(road, track) and place.along >= road.length[track]
    if not at_end and place.distance + wp.length(wp.vec2(FRONT + 0.5 * WHEELBASE, 0.5 * GAUGE)) >= road.clear[track]:
        wheels = wheels_on_road(car, track, pose)
    car.wheels[world] = wheels
    locate_obstacles(world, car)


@wp.func
def locate_obstacles(world: int, car: CarArrays):
    """Find the obstacles before and behind the car, and whether it touches one."""
    track = car.tracks[world]
    least, greatest = float(wp.inf), float(-1.0)
    car.next_obstacle[world] = -1
    car.last_obstacle[world] = -1
    hit = bool(False)
    for number in range(car.obstacle_poses.shape[1]):
        if overlap(
            car.poses[world], wp.vec2(HALF_LENGTH, HALF_WIDTH), car.obstacle_poses[track, number], car.obstacle_half
        ):
            hit = True
        gap = gap_to(world, car, number)
        if gap < least:
            least = gap
            car.next_obstacle[world] = number
        if gap > greatest:
            greatest = gap
            car.last_obstacle[world] = number
    car.crashed[world] = hit


@wp.func
def gap_to(world: int, car: CarArrays, number: int) -> float:
    """Distance to an obstacle ahead along the centre line, at most once round the track [m].

    On an open track that to an obstacle behind is more than the track's length, so that all that are ahead come first.
    """
    track = car.tracks[world]
    position = car.obstacle_along[track, number]
    if car.backwards[world]:
        position = car.road.length[track] - position
    return around(position - car.along[world], car.road.period[track])


@wp.func
def follow_car(world: int, car: CarArrays):
    """Update the car's place and its progress after a control step."""
    track = car.tracks[world]
    front = car.fronts[world]
    along = car.along[world]
    window = car.road.window[track]
    locate_car(world, car, car.rows[world] - window, 2 * window + 1)
    moved = advance(car.road, track, along, car.along[world])
    car.moved[world] = moved
    car.travelled[world] = car.travelled[world] + moved
    car.steps[world] = car.steps[world] + 1
    standing = car.standing[world] + 1
    falling = car.falling[world] + 1
    if wp.length(car.fronts[world] - front) >= LEAST_MOVE:
        standing = 0
    if moved >= 0.0:
        falling = 0
    car.standing[world] = standing
    car.falling[world] = falling


@wp.func
def begin_car(world: int, car: CarArrays):
    """Finds the place of a car that was put down: searches the whole track, and forgets its past."""
    locate_car(world, car, 0, car.road.count[car.tracks[world]])
    car.commands[world] = wp.vec2(0.0, 0.0)
    car.travelled[world] = 0.0
    car.moved[world] = 0.0
    car.steps[world] = 0
    car.standing[world] = 0
    car.falling[world] = 0


@wp.func
def lap_of(world: int, car: CarArrays) -> float:
    """Way that makes a lap [m]: the track's length; on an open one, from where the episode began to the end."""
    track = car.tracks[world]
    lap = car.road.length[track]
    if is_open(car.road, track):
        # what is left is exactly 0 at the end, where the lap is what was travelled
        lap = wp.max(car.travelled[world] + (lap - car.along[world]), 1.0e-3)
    return lap


@wp.func
def progress_of(world: int, car: CarArrays) -> float:
    """Share of a lap that the car has driven since the episode began, at most 100 [%]; below 0 behind the place where it began."""
    return 100.0 * wp.min(car.travelled[world] / lap_of(world, car), 1.0)
