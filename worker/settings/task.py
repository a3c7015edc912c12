"""The settings of a task in a job's YAML: times, reward weights, training. Imported without torch, Warp and Newton."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import field, fields
from types import MappingProxyType
from typing import Annotated, Any, ClassVar

from pydantic import AfterValidator, ConfigDict, Field, TypeAdapter, ValidationError, WrapValidator
from pydantic.dataclasses import dataclass

from shared_store.contract.error_text import nearest, shown
from shared_store.volume.layout import Store
from worker.settings.overrides import Refused, configured, expecting, from_mapping, refused, training_sections
from worker.settings.ppo import PPOConfig

STRICT = ConfigDict(extra="forbid", strict=True, arbitrary_types_allowed=True)
"""Validation of configuration classes: no unknown field, and no value of another type."""

FACTORS = ("mass", "friction", "damping", "gains", "gravity")
"""Factors on the physics of each world."""
_SCENE = ("camera_position", "camera_angle", "colors")


def _ordered(ends: tuple[float, float]) -> tuple[float, float]:
    if ends[0] > ends[1]:
        raise ValueError
    return ends


Finite = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0)]
Count = Annotated[int, Field(ge=1)]
Substeps = Annotated[int, Field(ge=1, le=1000)]
Amount = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Rate = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Range = Annotated[tuple[Finite, Finite], Field(strict=False), AfterValidator(_ordered), expecting("[least, greatest]")]
Factors = Annotated[
    tuple[Amount, Amount],
    Field(strict=False),
    AfterValidator(_ordered),
    expecting("[least, greatest], two factors of 0 or more"),
]
PositiveFactors = Annotated[
    tuple[Rate, Rate],
    Field(strict=False),
    AfterValidator(_ordered),
    expecting("[least, greatest], two factors above 0"),
]


def _check_noise(value: Any, inner: Callable[[Any], Any]) -> Any:
    for name, amount in (value if isinstance(value, Mapping) else {None: value}).items():
        if not _is_finite(amount) or amount < 0.0:
            where = () if name is None else (name,)
            raise Refused(where, f"expected a number of 0 or more, found {shown(amount)}")
    return inner(value)


@dataclass(frozen=True, config=STRICT)
class Randomization:
    """Randomisation of a task's worlds. Factors are uniform in ``[least, greatest]``, one for each world.

    Raises:
        ValueError: A range is malformed, or a number is out of range.
    """

    mass: PositiveFactors = (1.0, 1.0)
    """Factor on masses and inertias."""
    friction: Factors = (1.0, 1.0)
    """Factor on the friction of all contacts."""
    damping: Factors = (1.0, 1.0)
    """Factor on the damping of the joints."""
    gains: Factors = (1.0, 1.0)
    """Factor on the strength of the actuators: a motor's torque, a servo's stiffness and damping."""
    gravity: Factors = (1.0, 1.0)
    """Factor on gravity."""
    push_interval: Amount = 0.0
    """Mean simulated time between two pushes of a world, at random times [s]; 0: none."""
    push_velocity: Amount = 0.0
    """A push adds to the robot's velocity, uniformly within +- this along the world's x and y [m/s]."""
    observation_noise: Annotated[Amount | Mapping[str, Amount], WrapValidator(_check_noise)] = 0.0
    """Standard deviation of the normal noise on measured observations; the policy's last action and its command stay exact. A number:
    for each observation, in the policy's units. A mapping: by name of the observation, with ``*`` for any letters, in the unit of the
    measured quantity [m, rad, m/s, rad/s]; if several names fit, the last one counts; if none does, there is no noise."""
    camera_position: Amount = 0.0
    """Greatest offset of each camera from its place, along each axis [m]."""
    camera_angle: Amount = 0.0
    """Greatest rotation of each camera about each of its axes [rad]."""
    colors: Amount = 0.0
    """Greatest change of the red, green and blue of each shape, of 1."""
    light: Factors = (1.0, 1.0)
    """Factor on the brightness of camera images."""
    action_latency: Annotated[int, Field(ge=0, le=64)] = 0
    """Greatest latency of controls [control steps]; each episode draws its own, from 0."""

    @property
    def scene(self) -> list[str]:
        """The active settings that only a camera sees."""
        return [name for name in _SCENE if getattr(self, name)] + (["light"] if self.light != (1.0, 1.0) else [])

    @property
    def draws_worlds(self) -> bool:
        """Whether the physics or scene of each world is drawn when it is built."""
        return bool(self.scene) or any(getattr(self, name) != (1.0, 1.0) for name in FACTORS)

    def __post_init__(self) -> None:
        if bool(self.push_interval) != bool(self.push_velocity):
            raise ValueError("push_interval and push_velocity: give both, or none")


def _is_finite(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _check_points(points: Any, inner: Callable[[Any], Any]) -> Any:
    inner(points)
    if any(not float(point[0]).is_integer() or point[0] < 0 for point in points):
        raise Refused((), f"an iteration is a whole number from 0 up, found {shown(points)}")
    if any(after[0] <= before[0] for before, after in itertools.pairwise(points)):
        raise Refused((), f"the iterations of its points must grow, found {shown(points)}")
    return points


Points = Annotated[
    Sequence[Annotated[tuple[Finite, Finite], Field(strict=False)]],
    Field(min_length=1),
    expecting("points [iteration, value]"),
    WrapValidator(_check_points),
]


def value_at(points: Sequence[Sequence[float]], iteration: int) -> float:
    """The value of a curriculum's ``points`` in an iteration, counted from 0."""
    for before, after in itertools.pairwise(points):
        if before[0] <= iteration < after[0]:
            return before[1] + (after[1] - before[1]) * (iteration - before[0]) / (after[0] - before[0])
    return points[0][1] if iteration < points[0][0] else points[-1][1]


def reward_weights(**weights: float) -> Any:
    """The ``rewards`` field of a task's configuration, for weights that a submission checks: the terms in their order.

    Args:
        **weights: Default weight of each term; that of a cost is negative.
    """
    return field(default_factory=lambda: MappingProxyType(weights))


def default_rewards(config_type: type[TaskConfig]) -> Mapping[str, float]:
    """Terms and weights as ``config_type`` defines them, in their order."""
    factory: Any = next(item.default_factory for item in fields(config_type) if item.name == "rewards")
    weights: Mapping[str, float] = factory()
    return weights


class _InOneLine(type):
    """Refuses a value in Python as it is refused in a job's YAML: in one line."""

    def __call__(cls, *arguments: Any, **values: Any) -> Any:
        try:
            return super().__call__(*arguments, **values)
        except ValidationError as error:
            raise refused(error, (), values) from error


@dataclass(frozen=True, config=STRICT)
class _Common(metaclass=_InOneLine):
    """The fields of :class:`TaskConfig`, each checked by itself."""

    control_hz: Rate = 60.0
    """Control steps per simulated second [Hz]."""
    substeps: Substeps = 2
    """Physics steps of one control step."""
    episode_seconds: Positive = 10.0
    """Simulated time after which the clock ends an episode [s]."""
    rewards: Mapping[str, Finite] = reward_weights()
    """Weight of each reward term, in place of the one beside the term. Terms that are not named keep the task's."""
    randomize: Annotated[Randomization, from_mapping(Randomization)] = Randomization()
    """Randomisation of the worlds; none by default. A mapping of its fields is accepted."""
    curriculum: Mapping[str, Points] = field(default_factory=lambda: MappingProxyType({}))
    """Changes during training: ``[iteration, value]`` points in the order of the iterations, linearly interpolated and held constant
    outside their range. Each is named after a reward term, whose weight it sets; the place of a number of the task, such as
    ``events.push.speed`` (at a place with several numbers, it sets all); or ``level``, the difficulty of the task from 0 to 1 (of
    pushes and of the Quadruped's commands; a task of your own reads ``episodes.level``)."""
    numbers: Mapping[str, Finite | Sequence[Finite]] = field(default_factory=lambda: MappingProxyType({}))
    """Numbers of the task by their place, such as ``rewards.track_linear.std``: ``muster tasks NAME`` lists them."""
    fastest: Positive = 1000.0
    """Joint velocity at which the physics counts as failed [m/s, rad/s]: the world is reset, as after a NaN."""
    nan_limit: Amount = 0.1
    """Training stops when one iteration has more resets of failed worlds than this share of the number of worlds."""
    ppo: PPOConfig = field(default_factory=PPOConfig)
    """Settings of the task's training."""


@dataclass(frozen=True, config=STRICT)
class TaskConfig(_Common):
    """The settings of every task; a task adds its own fields.

    A subclass is a pydantic dataclass with ``config=STRICT``, or a plain one, whose own fields are checked only when they come
    from a job's YAML.

    Raises:
        ValueError: A value has the wrong type or is out of range.
    """

    further_groups: ClassVar[Mapping[str, bool]] = MappingProxyType({})
    """Observation groups besides ``policy`` and ``critic``, and whether each holds images, such as ``{"camera": True}``; also ``policy``,
    if a declaration makes it an image. Submission checks jobs against these names."""
    may_change: ClassVar[tuple[str, ...]] = ()
    """Fields that change nothing of a training, so that a run may go on with other values."""
    hyperparameters: ClassVar[tuple[str, ...]] = ()
    """Further names for settings that ``train.hyperparameters`` accepts (:meth:`plain_settings`)."""
    other_rewards: ClassVar[Mapping[str, float]] = MappingProxyType({})
    """Reward terms and weights that replace the default ones if :attr:`has_other_rewards`."""

    @classmethod
    def problem_with(cls, overrides: Mapping[str, Any]) -> tuple[tuple[str | int, ...], str] | None:
        """The error in a job's ``train.config``: the keys to the value, and one line; None: it is valid.

        Only this checks names of terms; without it, the task does, which may have others besides.
        """
        try:
            config = cls.configured(overrides)
        except Refused as error:
            return error.path, error.words
        known = config.default_weights
        for name in config.rewards:
            if known and name not in known:
                return ("rewards", name), f"the task has no term {shown(name)}; {nearest(name, known)}"
        for name in config.curriculum:
            if (
                known and name != "level" and name not in known and "." not in name
            ):  # only the built task has the places
                return ("curriculum", name), f"there is no such term; {nearest(name, ['level', *known])}"
        return None

    @classmethod
    def configured(cls, overrides: Mapping[str, Any]) -> TaskConfig:
        """The configuration with a job's ``train.config``. Raises Refused."""
        return configured(cls, overrides)

    @classmethod
    def plain_settings(cls, train: Mapping[str, Any]) -> tuple[dict[str, Any], list[str]]:
        """A job's ``train`` section with plain settings in place of its ``hyperparameters``, for which a task may have other names.

        Args:
            train: From the YAML; its other keys are not checked yet.

        Returns:
            The section, and a line for each hyperparameter whose setting is not exactly equivalent.

        Raises:
            Refused: A hyperparameter can't be used, or the task has none.
        """
        raise Refused(("hyperparameters",), f"{cls.__name__} has none; settings of PPO stand under train.ppo")

    @classmethod
    def stored_names(cls, overrides: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
        """What a job's ``train.config`` names in the store: key and name, for :meth:`missing`."""
        yield from ()

    @classmethod
    def missing(cls, store: Store, key: str, name: str) -> str | None:
        """Why the store can't give what ``key`` names, in one line; None: it can."""
        return None

    def notes(self, algorithm: str) -> list[str]:
        """A line for each value that is taken but not meant, or not done, exactly so; reported at the submission.

        Args:
            algorithm: Name of the algorithm that trains.
        """
        return []

    @property
    def default_weights(self) -> Mapping[str, float]:
        """The weights that the settings name, in their order."""
        return self.other_rewards if self.has_other_rewards else default_rewards(type(self))

    @property
    def has_other_rewards(self) -> bool:
        """Whether :attr:`other_rewards` are the task's reward terms; no, by default."""
        return False

    @property
    def observation_groups(self) -> Mapping[str, bool]:
        """The task's observation groups, and whether each holds images."""
        return {"policy": getattr(self, "camera", None) is not None, "critic": False, **self.further_groups}

    @property
    def chooses(self) -> bool:
        """Whether the policy chooses one of several actions, instead of giving numbers; False where only the task knows."""
        return False

    @property
    def policy_sizes(self) -> Mapping[str, str]:
        """The settings that decide the sizes of the policy's inputs and outputs, by key of the configuration, in words.

        A clone can't change them. Empty where only the task knows.
        """
        return {}

    @classmethod
    def __get_pydantic_json_schema__(cls, core_schema: Any, handler: Any) -> dict[str, Any]:
        """JSON Schema of ``train.config``: the names of the terms, without the fields that have sections of their own."""
        document: dict[str, Any] = handler.resolve_ref_schema(handler(core_schema))
        properties, known = document["properties"], {**default_rewards(cls), **cls.other_rewards}
        for name in training_sections():
            properties.pop(name, None)
        points = TypeAdapter(Points).json_schema()
        for name, terms in (
            ("rewards", {term: {"type": "number", "default": weight} for term, weight in known.items()}),
            ("curriculum", dict.fromkeys(("level", *known), points)),
        ):
            properties[name] = {"type": "object", "properties": terms, "additionalProperties": not known}
        return document

    def __post_init__(self) -> None:
        # again, without a subclass's types of these fields; a plain dataclass has not been checked at all
        checked = _Common(**{item.name: getattr(self, item.name) for item in fields(_Common)})
        for item in fields(_Common):
            object.__setattr__(self, item.name, getattr(checked, item.name))
        known = self.default_weights
        supplied = {} if self.rewards == default_rewards(type(self)) else self.rewards  # none were given
        points = self.curriculum.get("level", ())
        if not all(0.0 <= value <= 1.0 for _, value in points):
            raise Refused(("curriculum", "level"), f"expected levels from 0 to 1, found {shown(points)}")
        groups, scene = self.observation_groups, self.randomize.scene
        if scene and not any(groups.values()):
            raise Refused(("randomize", scene[0]), f"{type(self).__name__} has no camera that would see it")
        if self.randomize.observation_noise and groups["policy"]:
            raise Refused(("randomize", "observation_noise"), "it is for numbers, not for images; use light and colors")
        weights = {name: float(weight) for name, weight in {**known, **supplied}.items()}
        object.__setattr__(self, "rewards", MappingProxyType(weights))
        object.__setattr__(self, "curriculum", MappingProxyType(dict(self.curriculum)))
        object.__setattr__(self, "numbers", MappingProxyType(dict(self.numbers)))
