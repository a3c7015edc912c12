"""The inputs of a learner's reward function for every car, filled on the device after each control step, and the function itself."""

from __future__ import annotations

import math
import weakref
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import torch
import warp as wp

from racer.car.car_arrays import CarArrays, ahead_of, progress_of
from racer.car.courses import courses_of
from racer.rewards.compiled_function import RaceArrays
from racer.rewards.parameters import NUMBER_COLUMNS, OBJECT_COLUMNS
from racer.rewards.parameters import OBJECT_COUNT as COUNT
from racer.rewards.parameters import TRACK as TRACK_ROW
from racer.rewards.reward import RewardFunction, checked, compiled_function
from racer.rewards.reward_file import RewardFile
from racer.settings.task import FrontCameraConfig
from racer.tracks.circuit import BOX, Circuit
from racer.tracks.geometry import project
from racer.tracks.road import is_open
from worker.simulation.sensors.sensor import SensorContext

if TYPE_CHECKING:
    from worker.simulation.robot_view import RobotView

wp.set_module_options({"enable_backward": False})

_N, _O = NUMBER_COLUMNS, OBJECT_COLUMNS
ALL_WHEELS, X, Y = (wp.constant(_N[name]) for name in ("all_wheels_on_track", "x", "y"))
HEADING, DISTANCE = wp.constant(_N["heading"]), wp.constant(_N["distance_from_center"])
LEFT, REVERSED = wp.constant(_N["is_left_of_center"]), wp.constant(_N["is_reversed"])
CRASHED, OFF_TRACK = wp.constant(_N["is_crashed"]), wp.constant(_N["is_offtrack"])
PROGRESS, STEPS, SPEED = wp.constant(_N["progress"]), wp.constant(_N["steps"]), wp.constant(_N["speed"])
STEERING, LENGTH = wp.constant(_N["steering_angle"]), wp.constant(_N["track_length"])
WIDTH, WAYPOINTS = wp.constant(_N["track_width"]), wp.constant(_N["closest_waypoints"])
OBJECTS, ALONG = wp.constant(_N["closest_objects"]), wp.constant(_N["projection_distance"])
TIME, SEEN = wp.constant(_N["sim_time"]), wp.constant(_N["object_in_camera"])
OBJECT_COUNT, TRACK = wp.constant(COUNT), wp.constant(TRACK_ROW)
O_PLACE, O_ALONG = wp.constant(_O["objects_location"]), wp.constant(_O["objects_distance"])
O_HEADING, O_LEFT = wp.constant(_O["objects_heading"]), wp.constant(_O["objects_left_of_center"])
O_DISTANCE = wp.constant(_O["objects_distance_from_center"])
HALF_HEIGHT = wp.constant(BOX[2] / 2)


@wp.struct
class CameraView:
    """The objects in the image of the camera on the car.

    Attributes:
        place: On the car: ahead of its middle, to the left, above the road [m].
        pitch: How far it looks down [rad].
        wide: Tangent of half its horizontal angle.
        high: Tangent of half its vertical angle.
    """

    place: wp.vec3
    pitch: float
    wide: float
    high: float


@wp.func
def in_image(view: CameraView, point: wp.vec3) -> bool:
    """Whether the camera sees a point ahead of the car's middle, to the left, above the road [m], where nothing hides it."""
    offset = point - view.place
    depth = offset[0] * wp.cos(view.pitch) - offset[2] * wp.sin(view.pitch)
    up = offset[0] * wp.sin(view.pitch) + offset[2] * wp.cos(view.pitch)
    return depth > 0.0 and wp.abs(offset[1]) <= depth * view.wide and wp.abs(up) <= depth * view.high


@wp.func
def sees_box(view: CameraView, pose: wp.vec3, box: wp.vec3, half: wp.vec2) -> bool:
    """Whether the middle of a box or one of its eight corners is in the image of a car at ``pose``."""
    cosine = wp.cos(pose[2])
    sine = wp.sin(pose[2])
    seen = bool(False)
    for corner in range(9):
        forward, sideward, up = float(0.0), float(0.0), HALF_HEIGHT
        if corner < 8:
            forward = half[0] * (2.0 * float(corner % 2) - 1.0)
            sideward = half[1] * (2.0 * float((corner / 2) % 2) - 1.0)
            up = HALF_HEIGHT * 2.0 * float(corner / 4)
        offset = ahead_of(box, forward, sideward) - wp.vec2(pose[0], pose[1])
        if in_image(view, wp.vec3(offset[0] * cosine + offset[1] * sine, offset[1] * cosine - offset[0] * sine, up)):
            seen = True
    return seen


@wp.func
def as_number(truth: bool) -> float:
    """A truth value as a number."""
    number = float(0.0)
    if truth:
        number = 1.0
    return number


@wp.kernel
def _report(
    car: CarArrays,
    view: CameraView,
    sides: wp.array2d[wp.float32],
    seconds: float,
    race: RaceArrays,
):
    """Fill a car's rows; ``sides``: how far each obstacle of each track lies left of the centre line in the order of the waypoints [m]."""
    world = wp.tid()
    numbers = race.numbers[world]
    track = car.tracks[world]
    backwards = car.backwards[world]
    pose = car.poses[world]
    length = car.road.length[track]
    numbers[ALL_WHEELS] = as_number(car.wheels[world] == 4)
    numbers[X] = car.fronts[world][0]
    numbers[Y] = car.fronts[world][1]
    numbers[HEADING] = wp.degrees(pose[2])
    numbers[DISTANCE] = car.distances[world]
    numbers[LEFT] = as_number(car.left[world])
    numbers[REVERSED] = as_number(backwards)
    numbers[CRASHED] = as_number(car.crashed[world])
    numbers[OFF_TRACK] = as_number(car.wheels[world] == 0)
    numbers[PROGRESS] = progress_of(world, car)
    numbers[STEPS] = float(car.steps[world])
    numbers[STEERING] = wp.degrees(car.commands[world][0])
    numbers[SPEED] = car.commands[world][1]
    numbers[LENGTH] = length
    numbers[WIDTH] = car.widths[world]
    numbers[WAYPOINTS] = float(car.before[world])
    numbers[WAYPOINTS + 1] = float(car.after[world])
    numbers[OBJECTS] = float(wp.max(car.last_obstacle[world], 0))
    numbers[OBJECTS + 1] = float(wp.max(car.next_obstacle[world], 0))
    numbers[ALONG] = car.along[world]
    numbers[TIME] = float(car.steps[world]) * seconds
    count = car.obstacle_poses.shape[1]
    numbers[OBJECT_COUNT] = float(count)
    line = track
    if backwards:  # behind the tracks' lines stand the same ones turned round
        line += car.road.first.shape[0]
    numbers[TRACK] = float(line)
    seen = bool(False)
    for number in range(count):
        box = car.obstacle_poses[track, number]
        row = race.objects[world, number]
        along = car.obstacle_along[track, number]
        side = sides[track, number]
        if backwards:
            side = -side
            if along > 0.0 or is_open(car.road, track):
                along = length - along
        row[O_PLACE] = box[0]
        row[O_PLACE + 1] = box[1]
        row[O_ALONG] = along
        row[O_HEADING] = 0.0
        row[O_LEFT] = as_number(side > 0.0)
        row[O_DISTANCE] = wp.abs(side)
        if number == car.next_obstacle[world]:
            seen = sees_box(view, pose, box, car.obstacle_half)
    numbers[SEEN] = as_number(seen)


@dataclass(frozen=True)
class RewardInputs:
    """The arguments of a reward function for every car, and its call.

    Attributes:
        circuit: The tracks.
        reward: The function.
        front: The camera that may see an obstacle.
        function: Of Warp, ``(world, race) -> float``; None: it runs in Python workers.
        reason: Why, one line; empty where it is compiled.
        notes: What the compiled function leaves out, a line each.
    """

    circuit: Circuit
    reward: RewardFile
    front: FrontCameraConfig
    function: Any
    reason: str
    notes: tuple[str, ...]
    warnings: tuple[str, ...]
    arrays_type: ClassVar[Any] = RaceArrays

    @classmethod
    def of(cls, circuit: Circuit, reward: RewardFile, front: FrontCameraConfig, device: str) -> RewardInputs:
        """A reward function on a device; of an empty one, as of a task without worlds, it is neither tried nor compiled.

        Raises:
            ValueError: The guard refuses it.
        """
        problem, warnings = checked(reward.text, reward.file, courses_of(circuit)) if device else (None, ())
        if problem:
            raise ValueError(f"config.reward_function: {problem}")
        function, _, reason, notes = compiled_function(reward.text, reward.file, device)
        return cls(circuit, reward, front, function, reason, notes, warnings)

    def rows(self, views: Mapping[str, RobotView]) -> list[str]:
        """None: a term that reads it is called once."""
        return []

    def build(self, context: SensorContext) -> Racing:
        """The rows of these worlds."""
        return Racing(self, context)


class Racing:
    """:class:`RewardInputs` of some worlds; see :class:`worker.simulation.sensors.sensor.Sensor`. It has no state: all follows from the cars,
    but for what a function in Python workers remembers, which no checkpoint has.

    Args:
        declared: As a task declares it.
        context: The worlds.

    Attributes:
        arrays: What the cars' functions read.
        reward: The function.
        called: Whether it is called: a trial step, before the worlds begin, is not a step of a car.
    """

    needs_bodies = False

    def __init__(self, declared: RewardInputs, context: SensorContext) -> None:
        self.names: tuple[str, ...] = ()
        self._device = context.device
        self._worlds, self._seconds = context.worlds.world_count, 1.0 / context.control_hz
        circuit, front = declared.circuit, declared.front
        lines = [track.line().tolist() for track in circuit.tracks]
        lines += [line[::-1] for line in lines]
        reward, compiled = declared.reward, declared.function is not None
        # each rank has its own share of the processors, which torch knows
        processes = max(1, min(torch.get_num_threads(), -(-self._worlds // 16)))
        self.reward = RewardFunction(
            reward.text,
            lines,
            self._worlds,
            self._device,
            reward.file,
            compiled=compiled,
            processes=processes,
            courses=courses_of(circuit),
        )
        weakref.finalize(self, self.reward.close)
        self.arrays = self.reward.race
        view = self._view = CameraView()
        view.place, view.pitch = wp.vec3(*front.position), front.pitch
        view.high = math.tan(front.fov / 2)
        view.wide = view.high * front.width / front.height
        sides = np.zeros(circuit.obstacle_along.shape, np.float32)
        for row, poses, track in zip(sides, circuit.obstacle_poses, circuit.tracks, strict=True):
            found = project(track, poses[:, :2])
            row[:] = np.where(found.left, found.distance, -found.distance)
        self._sides = wp.array(sides, dtype=wp.float32, device=self._device)
        self._cars: Any = None
        self.called = False

    def begin_anew(self) -> None:
        """Begin as if no car had driven: what the function remembers, and its failures, are forgotten."""
        self.called = True
        self.reward.begin_anew()

    def follow(self, cars: Any) -> None:
        """Tell of these cars (``CarArrays``) from now on."""
        self._cars = cars

    def advance(self) -> None:
        """After a control step."""
        inputs = [self._cars, self._view, self._sides, self._seconds, self.arrays]
        wp.launch(_report, dim=self._worlds, inputs=inputs, device=self._device)

    def settle(self) -> None:
        """Nothing: the function of a car that was just placed reads it after the first step."""

    def state_tensors(self) -> dict[str, torch.Tensor]:
        """None."""
        return {}
