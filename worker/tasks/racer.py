"""Racing: a car of 1:18 that drives laps on a track, from what it is told of the road or from its camera."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from typing import Any, ClassVar

import newton

from shared_store.layout import Store
from worker.racer import terms as racing
from worker.racer.actions import CAMERA, ActionSpace
from worker.racer.car import Cars
from worker.racer.car_arrays import progress_of
from worker.racer.checks import BadTrack
from worker.racer.circuit import circuit_of
from worker.racer.lidar import lidar_sees
from worker.racer.naming import resolve
from worker.racer.scenery import CAR, add_scenery
from worker.racer.track import Track
from worker.simulation.robot import Robot
from worker.simulation.sensors.camera import CameraSensor
from worker.tasks import terms
from worker.tasks.configs.racer import RacerConfig, RacerPixelsAndStateConfig, RacerPixelsConfig
from worker.tasks.declaration import (
    Action,
    Choice,
    Declaration,
    Event,
    Image,
    Metric,
    Observation,
    Reward,
    Termination,
)
from worker.tasks.declared import DeclaredTask
from worker.tasks.overrides import Refused


class Racer(DeclaredTask):
    """A car that sees the road ahead as numbers: 21 observations, 2 actions, 15 control steps a second, episodes of 60 s."""

    config_type = RacerConfig
    solver_options: ClassVar[dict[str, object]] = {"disable_contacts": True, "njmax": 1, "nconmax": 0}

    def robot(self, config: RacerConfig) -> Robot:
        """The car."""
        return Robot(CAR, passive=True)

    def build(self, builder: newton.ModelBuilder) -> None:
        """As :meth:`DeclaredTask.build`, with the tracks around the car.

        Raises:
            ValueError: A track, an action space or an obstacle can't be.
        """
        config: Any = self.config
        try:
            self.circuit = circuit_of(tracks_of(config), config.obstacles)
            self.actions_of_car = config.actions()
            self.lidar = config.lidar_of(self.actions_of_car)
        except BadTrack as error:
            raise ValueError(f"config.track: {error}") from error
        except Refused as error:
            raise ValueError(f"config.{error}") from error
        super().build(builder)
        add_scenery(builder, self.circuit)

    def move(self) -> None:
        """Drive every car for one control step: the bicycle's rule, and no physics."""
        self.sensors["car"].move()

    def declare(self, config: RacerConfig) -> Declaration:
        """The terms."""
        return Declaration(
            actions=action_terms(self.actions_of_car),
            observations=self.observations_of(config),
            rewards=self.rewards_of(config),
            terminations={
                "lap_complete": Termination(racing.lap_complete),
                "crashed": Termination(racing.hit_obstacle),
                "off_track": Termination(racing.left_road),
                "immobilized": Termination(racing.immobilized, steps=config.stuck_steps),
                "reversed": Termination(racing.reversed_course, steps=config.stuck_steps),
            },
            events={
                "place": Event(
                    racing.place_car,
                    lasting=1,
                    start=racing.STARTS.index(config.start),
                    step=config.start_step,
                    alternate=config.alternate_direction,
                    sideways=config.start_sideways,
                    turned=config.start_turned,
                    speed_factor=config.speed_factor,
                    steering_factor=config.steering_factor,
                    steering_offset=config.steering_offset,
                )
            },
            metrics={
                "progress": Metric(progress_of, at_end=True, shown="%"),
                "lap_time": Metric(racing.lap_time, at_end=True),
            },
            success="lap_complete",
            sensors=self.sensors_of(config),
        )

    def bundle_documents(self, algorithm: str) -> Mapping[str, Mapping[str, Any]]:
        """``model_metadata.json``, as DeepRacer has it."""
        sensors = [CAMERA] if hasattr(self.config, "front") else []
        if self.lidar is not None:
            sensors.append(("LIDAR", "SECTOR_LIDAR", "DISCRETIZED_SECTOR_LIDAR")[min(self.lidar.levels, 2)])
        return {"model_metadata.json": self.actions_of_car.metadata(sensors, algorithm)}

    def observations_of(self, config: RacerConfig) -> Mapping[str, Any]:
        """What the policy sees."""
        return {**self.road_terms(config), **self.lidar_term()}

    def rewards_of(self, config: RacerConfig) -> Mapping[str, Reward]:
        """What the car earns, by the names of ``config.rewards``. A reward function of a learner's own takes its place here.

        Such a term has the parameters ``world`` and ``car: CarArrays``, which has all that DeepRacer's reward functions are told.
        """
        return {
            "progress": Reward(racing.progress_made),
            "off_track": Reward(racing.left_road),
            "crashed": Reward(racing.hit_obstacle),
        }

    def sensors_of(self, config: RacerConfig) -> Mapping[str, Any]:
        """The cars, which are driven and followed like a sensor's measurements."""
        cars = Cars(
            self.circuit,
            self.actions_of_car.radians,
            config.speed_lag,
            config.steering_lag,
            config.substeps,
        )
        return {"car": cars}

    def road_terms(self, config: RacerConfig) -> Mapping[str, Observation]:
        """The road and the car in numbers."""
        seen = {
            "waypoint": Observation(
                racing.waypoint_ahead, size=config.waypoints, spacing=config.waypoint_spacing, unit="m"
            ),
            "lateral_error": Observation(racing.lateral_error, unit="m"),
            "heading_error": Observation(racing.heading_error, unit="rad"),
            "road_width": Observation(racing.road_width, unit="m"),
            **self.own_terms(),
        }
        if config.obstacles:
            names = ("obstacle_ahead", "obstacle_left")
            seen["obstacle"] = Observation(racing.obstacle_ahead, names=names, unit="m")
        return seen

    def lidar_term(self) -> Mapping[str, Observation]:
        """What the lidar sees, where the car has one."""
        if (lidar := self.lidar) is None:
            return {}
        seen = Observation(
            lidar_sees,
            size=lidar.size,
            sectors=lidar.sectors,
            rays=lidar.rays,
            levels=lidar.levels,
            field=lidar.field,
            least=lidar.least,
            reach=lidar.range,
            unit="1" if lidar.levels else "m",
        )
        return {"lidar": seen}

    def own_terms(self) -> Mapping[str, Observation]:
        """What a car knows of itself."""
        return {
            "speed": Observation(racing.car_speed, unit="m/s"),
            "steering": Observation(racing.car_steering, unit="rad"),
        }


class RacerPixels(Racer):
    """A car that sees through its camera alone: an image of 160 x 120 in grey, 2 actions, 15 control steps a second, episodes of 60 s."""

    config_type = RacerPixelsConfig

    def observations_of(self, config: RacerConfig) -> Mapping[str, Any]:
        """The image; the critic sees the road in numbers."""
        return {"policy": Image("front"), "critic": self.road_terms(config)}

    def sensors_of(self, config: Any) -> Mapping[str, Any]:
        """The cars and their cameras."""
        front = config.front
        x, y, z = front.position
        camera = CameraSensor(
            body="car",
            position=front.position,
            target=(x + math.cos(front.pitch), y, z - math.sin(front.pitch)),
            width=front.width,
            height=front.height,
            fov=front.fov,
            kind=front.kind,
            frames=front.frames,
            samples=front.samples,
        )
        return {**super().sensors_of(config), "front": camera}


class RacerPixelsAndState(RacerPixels):
    """A car that sees through its camera, and knows its speed and steering: an image and 2 numbers, 2 actions."""

    config_type = RacerPixelsAndStateConfig

    def observations_of(self, config: RacerConfig) -> Mapping[str, Any]:
        """Numbers and image in groups of their own; the critic sees the road."""
        return {
            "policy": {**self.own_terms(), **self.lidar_term()},
            "front": Image("front"),
            "critic": self.road_terms(config),
        }


def action_terms(space: ActionSpace) -> Mapping[str, Action] | Choice:
    """What the policy's output does: one of the choices, or steering and speed between their ends."""
    if space.choices:
        return Choice(racing.choose, names=space.names)
    low, high = (math.radians(end) for end in space.steering)
    slow, fast = space.speed
    steering = {"scale": (high - low) / 2, "offset": (high + low) / 2, "kind": "position", "unit": "rad"}
    speed = {"scale": (fast - slow) / 2, "offset": (fast + slow) / 2, "kind": "velocity", "unit": "m/s"}
    return {
        "steering": Action(terms.position_target, joints="steering", **steering),
        "speed": Action(terms.velocity_target, joints="speed", **speed),
    }


def tracks_of(config: RacerConfig) -> list[Track]:
    """The tracks that a configuration names; those of the store, where this process has one. Raises BadTrack."""
    store = Store(os.environ["MUSTER_STORE"]) if os.environ.get("MUSTER_STORE") else None
    return [resolve(name, store) for name in config.tracks]
