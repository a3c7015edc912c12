"""The racer's tasks: a 1:18 car drives laps on a track, from numbers about the road or from its camera."""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Mapping
from typing import Any

import newton
import torch
import warp as wp

from racer.car import resets
from racer.car import terms as racing
from racer.car.car import Cars
from racer.car.lidar import lidar_sees
from racer.car.reward_inputs import RewardInputs
from racer.car.scenery import CAR, add_scenery
from racer.car.sim_trace import model_documents
from racer.car.training_trace import TrainingTrace
from racer.rewards.reward_file import reward_file
from racer.settings.actions import CAMERA, ActionSpace
from racer.settings.task import FrontCameraConfig, RacerConfig, RacerPixelsAndStateConfig, RacerPixelsConfig
from racer.tracks.checks import BadTrack
from racer.tracks.circuit import circuit_of
from racer.tracks.naming import resolve
from racer.tracks.race_track import Track
from shared_store.contract.policy import Target
from shared_store.volume.layout import Run, Store
from worker.settings.overrides import Refused
from worker.simulation.capture import on_torch_stream
from worker.simulation.robot import Robot
from worker.simulation.sensors.camera import CameraSensor
from worker.tasks import terms
from worker.tasks.declare.declaration import (
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
from worker.tasks.run.step_log import StepLog
from worker.tasks.run.task import Task


class Racer(Task):
    """A car that sees the road ahead as numbers: 21 observations, 2 actions, 15 control steps a second, episodes of 60 s."""

    config_type = RacerConfig
    solver_options = {"disable_contacts": True, "njmax": 1, "nconmax": 0}

    def restart(self, seed: int, first_world: int) -> None:
        """As :meth:`Task.restart`: what a learner's reward function remembers begins anew, too."""
        if self.race:
            with on_torch_stream(self.device):
                self.sensors["race"].begin_anew()
        super().restart(seed, first_world)

    def robot(self, config: RacerConfig) -> Robot:
        """The car."""
        return Robot(CAR, passive=True)

    def build(self, builder: newton.ModelBuilder) -> None:
        """As :meth:`Task.build`, with the tracks around the car.

        Raises:
            ValueError: A track, an action space or an obstacle is invalid.
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
        self.race = self.race_of(config)
        super().build(builder)
        add_scenery(builder, self.circuit)

    def race_of(self, config: RacerConfig) -> RewardInputs | None:
        """The parameters of a learner's reward function, if any. Raises ValueError if the guard refuses it."""
        if config.reward_function is None:
            return None
        try:
            reward = reward_file(config.reward_function)
        except Refused as error:
            raise ValueError(f"config.reward_function: {error}") from error
        race = RewardInputs.of(
            self.circuit, reward, getattr(config, "front", FrontCameraConfig()), getattr(self, "device", "")
        )
        self.waits_for_host = race.function is None
        return race

    def _prepare(self) -> None:
        super()._prepare()
        if self.race:
            self.sensors["race"].follow(self.sensors["car"].arrays)

    def notes(self) -> list[str]:
        """Notes of the robot and the tracks, and the place where a learner's reward function runs (device or host) with the reason."""
        slants = [f"track {track.name}: {track.slant}" for track in self.circuit.tracks if track.slanted]
        notes = [*super().notes(), *slants]
        if self.race is None:
            return notes
        notes += self.race.warnings
        if not self.race.reason:
            return [*notes, f"{self.race.reward.file}: compiled to the device", *self.race.notes]
        graph = "; a step is no part of a CUDA graph" if self.device.startswith("cuda") else ""
        return [
            *notes,
            f"{self.race.reason}{graph}; each car has its own copy of the function and of what it remembers",
        ]

    def failures(self) -> dict[str, tuple[int, int]]:
        """The calls of a learner's reward function that returned no reward."""
        if self.race is None:
            return {}
        with on_torch_stream(self.device):
            found = self.sensors["race"].reward.failures()
        return {message: (each.count, self.first_world + each.car) for message, each in found.items()}

    def read_failed_world(self, code: int) -> tuple[int, str] | None:
        """As :meth:`Task.read_failed_world`, with the error of the reward function."""
        found = super().read_failed_world(code)
        if found is None or "reward" not in found[1]:
            return found
        return found[0], ": ".join((found[1], *list(self.failures())[:1]))

    def is_users_fault(self, cause: str) -> bool:
        """Whether a learner's reward function gave no reward."""
        return self.race is not None and "reward" in cause

    def begins_anew(self) -> str:
        """What a function in Python workers remembers."""
        if self.race is None or not self.waits_for_host:
            return ""
        return (
            f"{self.race.reward.file}: what the function remembered of each car begins anew, since no checkpoint has it"
        )

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
                "crashed": Termination(racing.ends_crashed),
                "off_track": Termination(racing.ends_off_track),
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
                    friction=config.friction,
                ),
                **resetting(config),
            },
            metrics={
                "progress": Metric(racing.final_progress, at_end=True, shown="%"),
                "lap_time": Metric(racing.lap_time, at_end=True),
                **incident_metrics(config),
            },
            success="lap_complete",
            sensors=self.sensors_of(config),
        )

    def bundle_documents(self, algorithm: str) -> Mapping[str, Mapping[str, Any]]:
        """``model_metadata.json`` in DeepRacer's format."""
        sensors = [CAMERA] if hasattr(self.config, "front") else []
        if self.lidar is not None:
            sensors.append(("LIDAR", "SECTOR_LIDAR", "DISCRETIZED_SECTOR_LIDAR")[min(self.lidar.levels, 2)])
        return {"model_metadata.json": self.actions_of_car.metadata(sensors, algorithm)}

    @staticmethod
    def traced_of(config: RacerConfig) -> int:
        """How many cars are noted in each control step: in a race all of them."""
        return sys.maxsize if config.trace else config.sim_trace

    def step_log(self, run: Run, steps: int, iteration: int, facts: Mapping[str, Any]) -> StepLog | None:
        """As :meth:`Task.step_log`: SimTrace files of the first cars, if the configuration asks for them."""
        if not getattr(self.config, "sim_trace", 0):
            return None
        documents = model_documents(self, facts["algorithm"], facts["settings"], facts["train"].get("worlds", 1))
        return TrainingTrace(run, self, steps, iteration, documents)

    def observations_of(self, config: RacerConfig) -> Mapping[str, Any]:
        """The policy's observations."""
        return {**self.road_terms(config), **self.lidar_term()}

    def rewards_of(self, config: RacerConfig) -> Mapping[str, Reward]:
        """The rewards, by the names of ``config.rewards``, or the result of a learner's reward function.

        Your own term has the parameters ``world`` and ``car: CarArrays``, which has all parameters of DeepRacer's reward functions.
        """
        if self.race:
            return {"reward": Reward(self.race.function or from_workers)}
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
            config.continuous,
            config.put_back,
            config.max_resets,
            config.stuck_steps,
            self.traced_of(config),
        )
        return {"car": cars, **({"race": self.race} if self.race else {})}

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
        """The lidar's observations, if the car has one."""
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
        """The car's observations of itself."""
        return {
            "speed": Observation(racing.car_speed, unit="m/s"),
            "steering": Observation(racing.car_steering, unit="rad"),
        }


class RacerPixels(Racer):
    """A car that sees only through its camera: a grey image of 160 x 120, 2 actions, 15 control steps a second, episodes of 60 s."""

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
    """A car that sees through its camera and observes its speed and steering: an image and 2 numbers, 2 actions."""

    config_type = RacerPixelsAndStateConfig

    def observations_of(self, config: RacerConfig) -> Mapping[str, Any]:
        """Numbers and image in separate groups; the critic sees the road."""
        return {
            "policy": {**self.own_terms(), **self.lidar_term()},
            "front": Image("front"),
            "critic": self.road_terms(config),
        }


def from_workers(task: Racer) -> torch.Tensor:
    """Rewards of a reward function that is not compiled, NaN where it failed, shape ``(worlds,)``; waits for the device.

    Raises:
        RewardFailed: A call does not return, floods its output or ends its process.
    """
    race = task.sensors["race"]
    if not race.called:
        return torch.zeros(task.world_count, device=task.device)
    with on_torch_stream(task.device):
        rewards: torch.Tensor = wp.to_torch(race.reward.rewards())
    return rewards


def action_terms(space: ActionSpace) -> Mapping[str, Action] | Choice:
    """The actions: one of the choices, or steering and speed between their limits."""
    if space.choices:
        targets = [
            (Target("steering", "position", "rad", angle), Target("speed", "velocity", "m/s", speed))
            for angle, speed in space.radians
        ]
        return Choice(racing.choose, names=space.names, targets=targets)
    low, high = (math.radians(end) for end in space.steering)
    slow, fast = space.speed
    return {
        "steering": Action(
            terms.position_target, joints="steering", scale=(high - low) / 2, offset=(high + low) / 2, unit="rad"
        ),
        "speed": Action(
            terms.velocity_target, joints="speed", scale=(fast - slow) / 2, offset=(fast + slow) / 2, unit="m/s"
        ),
    }


def resetting(config: RacerConfig) -> Mapping[str, Event]:
    """The event that puts cars back, in each control step, if enabled."""
    step = 1.0 / config.control_hz
    return {"put_back": Event(resets.put_back, when="interval", seconds=(step, step))} if config.continuous else {}


def incident_metrics(config: RacerConfig) -> Mapping[str, Metric]:
    """Metrics if cars are put back: how often and why, and the penalties [s]."""
    if not config.continuous:
        return {}
    off_track, crash = config.off_track_penalty, config.crash_penalty
    counts = {name: Metric(resets.happened, at_end=True, column=number) for number, name in enumerate(resets.COUNTS)}
    return {**counts, "penalty": Metric(resets.penalty, at_end=True, off_track=off_track, crash=crash)}


def tracks_of(config: RacerConfig) -> list[Track]:
    """The tracks that a configuration names, also from the store if this process has one. Raises BadTrack."""
    store = Store(os.environ["MUSTER_STORE"]) if os.environ.get("MUSTER_STORE") else None
    return [resolve(name, store) for name in config.tracks]
