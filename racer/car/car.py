"""The racer's car as a task has it: declared beside its sensors, moved by a kinematic model, read by its terms."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import torch
import warp as wp

from racer.car.car_arrays import CarArrays, ResetRules, begin_car, follow_car, move_car
from racer.car.resets import COUNTS, forget_incidents, go_on, note_incident
from racer.car.trace import COLUMNS, trace_car
from racer.tracks.circuit import BOX, Circuit
from racer.tracks.road import road_arrays
from worker.simulation.episodes import EpisodeArrays
from worker.simulation.robot_arrays import RobotArrays
from worker.simulation.sensors.sensor import SensorContext
from worker.simulation.structs import views_of
from worker.simulation.worlds import WorldArrays

if TYPE_CHECKING:
    from worker.simulation.robot_view import RobotView

wp.set_module_options({"enable_backward": False})

LASTING = (
    *("tracks", "backwards", "poses", "speeds", "steerings", "factors", "commands", "fronts", "rows", "along"),
    *("travelled", "steps", "standing", "falling"),
)
"""The state that the next control step reads; the rest follows from it."""
SHAPED = {
    wp.vec2: ("commands", "fronts"),
    wp.vec3: ("poses", "put_poses"),
    wp.vec4: ("factors",),
    wp.bool: ("backwards", "left", "crashed", "put"),
}
COUNTED = (
    "tracks",
    "rows",
    "before",
    "after",
    "wheels",
    "steps",
    "standing",
    "falling",
    "next_obstacle",
    "last_obstacle",
    "incidents",
)
MEASURED = ("speeds", "steerings", "distances", "along", "headings", "widths", "travelled", "moved", "set_back")


@wp.kernel
def _move(
    worlds: WorldArrays,
    robot: RobotArrays,
    car: CarArrays,
    speed_lag: float,
    steering_lag: float,
    seconds: float,
    parts: int,
):
    move_car(wp.tid(), worlds, robot, car, speed_lag, steering_lag, seconds, parts)


@wp.kernel
def _follow(car: CarArrays):
    world = wp.tid()
    follow_car(world, car)
    note_incident(world, car)


@wp.kernel
def _trace(car: CarArrays):
    trace_car(wp.tid(), car)


@wp.kernel
def _begin(episodes: EpisodeArrays, car: CarArrays):
    world = wp.tid()
    if episodes.ages[world] == 0:
        begin_car(world, car)
        forget_incidents(world, car)
    elif car.put[world]:
        go_on(world, car)


@dataclass(frozen=True)
class Cars:
    """A car in every world; world number w, counted over all ranks, drives track w modulo their number.

    Attributes:
        circuit: The tracks.
        choices: Steering [rad] and speed [m/s] of each choice; empty where actions are continuous.
        speed_lag: Time constant of the speed [s].
        steering_lag: Time constant of the steering [s].
        parts: Parts of a control step in which the motion is integrated.
        continuous: Whether a car that can't go on is put back; else its episode ends.
        put_back: How far behind where it was [m].
        max_resets: How often in an episode; the next time it ends.
        stuck_steps: Control steps in a row of standing, or of coming back, after which a car does not go on.
        traced: How many cars, from the first, :mod:`racer.car.trace` notes in each control step; all at most.
    """

    circuit: Circuit
    choices: Sequence[tuple[float, float]] = ()
    speed_lag: float = 0.0
    steering_lag: float = 0.0
    parts: int = 4
    continuous: bool = False
    put_back: float = 1.0
    max_resets: int = 100
    stuck_steps: int = 15
    traced: int = 0
    arrays_type: ClassVar[Any] = CarArrays
    meaning: ClassVar[str] = "Cars"
    """The car's part of a policy's contract: its measurements are the same on every track."""

    def rows(self, views: Mapping[str, RobotView]) -> list[str]:
        """None: a term that reads the car is called once."""
        return []

    def build(self, context: SensorContext) -> Driving:
        """The cars of these worlds."""
        return Driving(self, context)


class Driving:
    """:class:`Cars` of some worlds; see :class:`worker.simulation.sensors.sensor.Sensor`. All methods are launches alone.

    Args:
        declared: As a task declares it.
        context: The worlds.
    """

    needs_bodies = False

    def __init__(self, declared: Cars, context: SensorContext) -> None:
        self.names: tuple[str, ...] = ()
        self._count, self._device = context.worlds.world_count, context.device
        self._episodes = context.episodes
        device = context.device
        arrays = self.arrays = CarArrays()
        circuit = declared.circuit
        arrays.road = road_arrays(circuit.tracks, circuit.corners, device)
        arrays.choices = wp.array(np.array(declared.choices, np.float32).reshape(-1, 2), dtype=wp.vec2, device=device)
        arrays.obstacle_half = wp.vec2(BOX[0] / 2, BOX[1] / 2)
        arrays.obstacle_poses = wp.array(circuit.obstacle_poses.astype(np.float32), dtype=wp.vec3, device=device)
        arrays.obstacle_along = wp.array(circuit.obstacle_along.astype(np.float32), dtype=wp.float32, device=device)
        kinds = {name: kind for kind, names in SHAPED.items() for name in names}
        kinds |= dict.fromkeys(COUNTED, wp.int32) | dict.fromkeys(MEASURED, wp.float32)
        for name, kind in kinds.items():
            setattr(arrays, name, wp.zeros(self._count, dtype=kind, device=device))
        arrays.counts = wp.zeros((self._count, len(COUNTS)), dtype=wp.int32, device=device)
        self._traced = min(declared.traced, self._count)
        arrays.trace = wp.zeros((self._traced, len(COLUMNS)), dtype=wp.float32, device=device)
        self._lasting = (*LASTING, "counts") if declared.continuous else LASTING
        rules = ResetRules()
        rules.continuous, rules.put_back = declared.continuous, declared.put_back
        rules.max_resets, rules.stuck_steps = declared.max_resets, declared.stuck_steps
        arrays.rules = rules  # a copy: it has to be complete
        self._moving = [context.worlds.arrays, context.robots["robot"], arrays]
        self._moving += [declared.speed_lag, declared.steering_lag, 1.0 / context.control_hz, declared.parts]

    def move(self) -> None:
        """One control step of every car, by the controls of its world."""
        wp.launch(_move, dim=self._count, inputs=self._moving, device=self._device)

    def advance(self) -> None:
        """Updates the places of the cars after a control step."""
        wp.launch(_follow, dim=self._count, inputs=[self.arrays], device=self._device)
        if self._traced:
            self.note()

    def note(self) -> None:
        """Write what is known of the cars now into ``arrays.trace``."""
        wp.launch(_trace, dim=self._traced, inputs=[self.arrays], device=self._device)

    def settle(self) -> None:
        """Updates the places of the cars that were put down or back."""
        wp.launch(_begin, dim=self._count, inputs=[self._episodes, self.arrays], device=self._device)

    def state_tensors(self) -> dict[str, torch.Tensor]:
        """The state that the next control step reads."""
        return views_of(self.arrays, *self._lasting)
