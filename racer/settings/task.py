"""The configurations of the racer's tasks."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import field
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field
from pydantic.dataclasses import dataclass

from racer.rewards.parameters import MOST_OBJECTS
from racer.rewards.reward_file import RewardFile
from racer.settings.actions import LIDARS, ActionSpace, action_space, read_metadata
from racer.settings.hyperparameters import KNOWN, plain_settings
from racer.store.leagues import problem_of_track
from racer.tracks.obstacles import ObstacleConfig
from shared_store.contract.file_fields import kept_file
from shared_store.volume.layout import Store
from worker.settings.overrides import Refused, expecting, from_mapping
from worker.settings.ppo import PPOConfig
from worker.settings.task import (
    FACTORS,
    STRICT,
    Amount,
    Count,
    Finite,
    Positive,
    PositiveFactors,
    Range,
    Rate,
    TaskConfig,
    reward_weights,
)

TrackName = Annotated[str, Field(min_length=1, max_length=100)]


@dataclass(frozen=True, config=STRICT)
class LidarConfig:
    """A lidar at the car's centre, which sees obstacles but not the road.

    Raises:
        ValueError: ``least`` is not below ``range``.
    """

    sectors: Annotated[int, Field(ge=1, le=128)] = 8
    """Sectors of the field of view, from right to left; each sees its nearest obstacle."""
    rays: Annotated[int, Field(ge=1, le=64)] = 8
    """Rays of each sector, at equal angles."""
    levels: Annotated[int, Field(ge=0, le=64)] = 0
    """0: a sector is the distance to that obstacle [m]; n: it is n numbers, of which the one for its part of the range is 1; with 1, the
    number says whether there is an obstacle."""
    field: Annotated[float, Field(gt=0, le=2 * math.pi)] = 5.236
    """Field of view, half of it to each side of the car's heading [rad]; 5.236 is 300 degrees."""
    least: Amount = 0.15
    """Distances of nearer obstacles are raised to this [m]."""
    range: Positive = 1.0
    """Farther obstacles are not seen [m]; without an obstacle, this is the distance."""

    def __post_init__(self) -> None:
        if self.least >= self.range:
            raise Refused(("least",), f"expected less than range ({self.range:g}), found {self.least:g}")

    @property
    def size(self) -> int:
        """Of its observation."""
        return self.sectors * max(1, self.levels)


@dataclass(frozen=True, config=STRICT)
class FrontCameraConfig:
    """The camera on the car."""

    width: Annotated[int, Field(ge=1, le=1024)] = 160
    """Of an image [px]."""
    height: Annotated[int, Field(ge=1, le=1024)] = 120
    """Of an image [px]."""
    kind: Literal["grey", "color"] = "grey"
    """One channel, or red, green and blue."""
    frames: Annotated[int, Field(ge=1, le=16)] = 1
    """Images of one observation: the present one and those of the control steps before."""
    samples: Annotated[int, Field(ge=1, le=64)] = 1
    """Rays of each pixel."""
    fov: Annotated[float, Field(gt=0, lt=math.pi)] = 0.887
    """Vertical field of view [rad]: with 4:3 the horizontal one is 1.13."""
    position: Annotated[tuple[Finite, Finite, Finite], Field(strict=False), expecting("[x, y, z]")] = (0.05, 0.0, 0.14)
    """On the car: ahead of its centre, to the left, above the road [m]."""
    pitch: Annotated[float, Field(gt=-1.5, lt=1.5)] = 0.262
    """Downward tilt [rad]; 0.262 is 15 degrees."""


@dataclass(frozen=True, config=STRICT)
class RacerConfig(TaskConfig):
    """A car of 1:18 on a track, which drives laps.

    Raises:
        ValueError: An action is out of range, ``randomize`` names physics that the car does not have, or :class:`TaskConfig` refuses
            a value.
    """

    may_change: ClassVar[tuple[str, ...]] = ("sim_trace",)
    hyperparameters: ClassVar[tuple[str, ...]] = tuple(KNOWN)
    other_rewards: ClassVar[Mapping[str, float]] = {"reward": 1.0}
    control_hz: Rate = 15.0
    """Control steps per simulated second [Hz]."""
    substeps: Annotated[int, Field(ge=1, le=64)] = 4
    """Parts of a control step in which the car's motion is integrated."""
    episode_seconds: Positive = 60.0
    """Simulated time after which the clock ends an episode [s]."""
    track: TrackName | Annotated[tuple[TrackName, ...], Field(strict=False, min_length=1, max_length=64)] = "oval"
    """A preset, ``random:SEED``, or a track of the store; of several, world w drives number w modulo their count."""
    action_space: Annotated[
        str | Mapping[str, Any] | list[Any], expecting("the path or the content of a model_metadata.json")
    ] = field(
        default_factory=lambda: {
            "action_space": {"steering_angle": {"low": -30, "high": 30}, "speed": {"low": 0.5, "high": 2.0}},
            "action_space_type": "continuous",
        },
        metadata=kept_file("json"),
    )
    """Contents or path of a ``model_metadata.json``, or the list of actions alone; steering in degrees, speed in m/s."""
    reward_function: Annotated[
        Annotated[RewardFile | str | None, expecting("the path of a reward function")], from_mapping(RewardFile)
    ] = field(
        default=None,
        metadata=kept_file("text", "racer.rewards", needs=("numpy", "scipy"), check_reads=("track", "obstacles")),
    )
    """Path of a file with ``def reward_function(params)``, which replaces all other rewards."""
    speed_lag: Amount = 0.2
    """Time constant of the speed's response [s]."""
    steering_lag: Amount = 0.05
    """Time constant of the steering [s]."""
    speed_factor: PositiveFactors = (1.0, 1.0)
    """Factor on the requested speed, uniform, drawn in every episode."""
    steering_factor: PositiveFactors = (1.0, 1.0)
    """Factor on the requested steering, uniform, drawn in every episode."""
    steering_offset: Range = (0.0, 0.0)
    """Offset of the requested steering [rad], uniform, drawn in every episode."""
    friction: Range = (0.0, 0.0)
    """Coefficient of friction between tyres and road, uniform, drawn in every episode: the car turns no faster than a lateral
    acceleration of 9.81 m/s² times this allows; [0, 0]: it never slides."""
    start: Literal["round_robin", "random", "line"] = "round_robin"
    """Start of an episode: ``start_step`` of the track farther than the previous one, anywhere, or at the start line."""
    start_step: Annotated[float, Field(ge=0, le=1)] = 0.05
    """A share of the track."""
    start_sideways: Range = (0.0, 0.0)
    """Start position left of the centre line [m], uniform."""
    start_turned: Range = (0.0, 0.0)
    """Start heading to the left of the track's direction [rad], uniform."""
    alternate_direction: bool = False
    """Whether every other episode drives against the order of the waypoints."""
    obstacles: Annotated[
        tuple[Annotated[ObstacleConfig, from_mapping(ObstacleConfig)], ...], Field(strict=False, max_length=64)
    ] = ()
    """Boxes on every track."""
    lidar: Annotated[LidarConfig | None, from_mapping(LidarConfig)] = None
    """A lidar through which the policy sees obstacles; the action space's sensors can also name one."""
    stuck_steps: Count = 15
    """Consecutive control steps of standing, or of driving back, that end an episode."""
    continuous: bool = False
    """Whether a car that leaves the road, crashes, stands or drives back is put back and drives on, instead of ending its episode."""
    put_back: Annotated[float, Field(gt=0, le=10)] = 1.0
    """Distance by which it is put back [m]."""
    off_track_penalty: Amount = 1.0
    """Time penalty of a lap each time that the car leaves the road [s]."""
    crash_penalty: Amount = 1.0
    """Time penalty for each touched obstacle [s]."""
    max_resets: Annotated[int, Field(ge=0, le=1_000_000)] = 100
    """Number of times that a car is put back in an episode; the next time, the episode ends."""
    sim_trace: Annotated[int, Field(ge=0, le=16)] = 0
    """Number of cars of the main rank, from the first, of which a training writes each control step into SimTrace files."""
    trace: bool = False
    """Whether to record each control step on the device for the files of a race; a race sets it."""
    waypoints: Annotated[int, Field(ge=1, le=64)] = 8
    """Number of observed points of the centre line ahead."""
    waypoint_spacing: Positive = 0.3
    """Their spacing along the centre line [m]."""
    rewards: Mapping[str, float] = reward_weights(progress=1.0, off_track=-10.0, crashed=-10.0)
    """Weights of these terms:

    - ``progress``: progress of the car, in percent of the track: a whole lap is 100;
    - ``off_track``: leaving the road, once;
    - ``crashed``: touching an obstacle, once;

    or, with a ``reward_function``, of the one term ``reward``: its result."""
    ppo: PPOConfig = field(default_factory=lambda: PPOConfig(entropy_coef=0.002))
    """Settings of the task's training."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in FACTORS:
            if getattr(self.randomize, name) != (1.0, 1.0):
                instead = "friction" if name == "friction" else "speed_factor, steering_factor and steering_offset"
                words = (
                    f"the car moves as a kinematic bicycle, without an engine's contacts; use train.config.{instead}"
                )
                raise Refused(("randomize", name), words)
        if self.friction != (0.0, 0.0) and self.friction[0] <= 0.0:
            raise Refused(("friction",), f"expected two numbers above 0, or [0, 0], found {list(self.friction)}")
        if self.randomize.push_interval:
            raise Refused(("randomize", "push_interval"), "nothing can push a car that moves as a kinematic bicycle")
        if not isinstance(self.action_space, str):
            try:
                action_space(self.action_space)
            except Refused as error:
                raise Refused(("action_space", *error.path), error.words) from None
            self.lidar_of(self.actions())
        if self.has_other_rewards and len(self.obstacles) > MOST_OBJECTS:
            words = f"a reward function gets at most {MOST_OBJECTS} objects, and there are {len(self.obstacles)}"
            raise Refused(("obstacles",), words)

    @property
    def has_other_rewards(self) -> bool:
        """Whether a reward function takes the place of the rewards."""
        return self.reward_function is not None

    def lidar_of(self, space: ActionSpace) -> LidarConfig | None:
        """The lidar: ``lidar``, or what the sensor of an action space is.

        Raises:
            Refused: There are both, or the task sees nothing but images.
        """
        if self.lidar is not None and space.lidar is not None:
            raise Refused(("lidar",), f"the action space has the sensor {space.lidar}, too; leave one of them out")
        if self.lidar is None and space.lidar is None:
            return None
        if self.further_groups.get("policy"):
            where = ("lidar",) if self.lidar else ("action_space", "sensor")
            raise Refused(where, "the policy of this task sees an image alone; use task RacerPixelsAndState")
        return self.lidar or LidarConfig(**LIDARS[str(space.lidar)])

    @classmethod
    def stored_names(cls, overrides: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
        """As :meth:`TaskConfig.stored_names`: the tracks."""
        named = overrides.get("track")
        names = [named] if isinstance(named, str) else named if isinstance(named, list | tuple) else []
        return (("track", name) for name in names if isinstance(name, str))

    @classmethod
    def missing(cls, store: Store, key: str, name: str) -> str | None:
        """As :meth:`TaskConfig.missing`."""
        return problem_of_track(store, name)

    @classmethod
    def plain_settings(cls, train: Mapping[str, Any]) -> tuple[dict[str, Any], list[str]]:
        """As :meth:`TaskConfig.plain_settings`, of DeepRacer's hyperparameters."""
        return plain_settings(train, cls())

    def notes(self, algorithm: str) -> list[str]:
        """As :meth:`TaskConfig.notes`, of an action space that the simulated car does not have exactly so."""
        if isinstance(self.action_space, str):
            return []
        space = self.actions()
        other = space.algorithm not in (None, algorithm)
        meant = [f"its training_algorithm is {space.algorithm}, and train.algorithm is {algorithm}"] if other else []
        return [f"action_space: {note}" for note in (*space.notes, *meant)]

    @property
    def chooses(self) -> bool:
        """As :attr:`TaskConfig.chooses`; False of an action space in a file, which a node reads."""
        return not isinstance(self.action_space, str) and bool(self.actions().choices)

    @property
    def policy_sizes(self) -> Mapping[str, str]:
        """As :attr:`TaskConfig.policy_sizes`."""
        if isinstance(self.action_space, str):
            return {}
        space = self.actions()
        lidar = self.lidar_of(space)
        return {
            "action_space": f"{len(space.choices)} actions to choose from" if space.choices else "ranges of 2 actions",
            "waypoints": str(self.waypoints),
            "lidar": f"one of {lidar.size} numbers" if lidar else "none",
            "obstacles": "some" if self.obstacles else "none",
        }

    @property
    def tracks(self) -> tuple[str, ...]:
        """The names of all tracks."""
        return (self.track,) if isinstance(self.track, str) else self.track

    def actions(self) -> ActionSpace:
        """The action space; of a file, relative to the working directory, where the job was submitted.

        Raises:
            ValueError: The file can't be read, or has none.
        """
        if isinstance(self.action_space, str):
            return read_metadata(Path(self.action_space))
        return action_space(self.action_space)


@dataclass(frozen=True, config=STRICT)
class RacerPixelsConfig(RacerConfig):
    """As :class:`RacerConfig`, seen through the camera on the car alone."""

    further_groups: ClassVar[Mapping[str, bool]] = {"policy": True}
    front: Annotated[FrontCameraConfig, from_mapping(FrontCameraConfig)] = field(default_factory=FrontCameraConfig)
    """The camera."""
    ppo: PPOConfig = field(
        default_factory=lambda: PPOConfig(
            hidden_sizes=(128,),
            epochs=4,
            minibatches=8,
            learning_rate=5.0e-4,
            entropy_coef=0.002,
            critic_observations="critic",
            critic_hidden_sizes=(128, 128),
        )
    )
    """Settings of the task's training; the critic also sees the numbers."""

    @property
    def policy_sizes(self) -> Mapping[str, str]:
        """As :attr:`TaskConfig.policy_sizes`."""
        front = self.front
        image = f"{front.frames} {front.kind} images of {front.width} x {front.height}"
        return {**super().policy_sizes, "front": image}


@dataclass(frozen=True, config=STRICT)
class RacerPixelsAndStateConfig(RacerPixelsConfig):
    """As :class:`RacerPixelsConfig`, with speed and steering beside the image; for ``rsl_rl``."""

    further_groups: ClassVar[Mapping[str, bool]] = {"front": True}
