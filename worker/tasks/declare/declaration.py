"""The declaration of a task: named terms for actions, observations, rewards, terminations, commands, events and curricula.

A term is a small Warp function with annotated parameters, see :mod:`worker.tasks.declare.functions`. Its numbers are data: a change
compiles nothing, and a job's YAML sets them under ``train.config.numbers`` by their place, such as
``rewards.track_linear.std``.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from shared_store.contract.policy import Target
from worker.simulation.declared_randomization import Randomize
from worker.tasks.declare.adaptive import Adaptive as Adaptive

Pattern = str | Sequence[str]
"""Names of joints, bodies or sites, one or several, with ``*`` for any letters; they are selected in the order of the model."""


class Term:
    """A function, the elements that it is applied to, and its numbers.

    Args:
        function: A ``@wp.func``; or a Python function ``(task, **parameters) -> torch.Tensor``, whose launches are captured. A parameter
            ``joints``, ``bodies`` or ``sites`` of such a function gets the indices of what the term selects, as a tensor.
        robot: Name of the robot or object to which ``RobotArrays`` and patterns refer.
        joints: The joints, for a function with a parameter ``joint``.
        bodies: The bodies, for a function with a parameter ``body``.
        sites: The sites, for a function with a parameter ``site``.
        size: For a function with a parameter ``index``, which is called with 0 to ``size - 1``: by default the number of columns of
            its sensor. For a torch term: the number of columns that it returns, 1 by default.
        memory: Count of its own numbers in ``episodes.memory``, from the column that its parameter ``memory`` gives; they are
            0 when an episode begins.
        lasting: As ``memory``, in ``episodes.lasting``, where they survive episodes.
        **parameters: Its numbers (float, or a tuple for a vector), and by name the sensors, commands and further robots for
            parameters of these kinds.
    """

    def __init__(
        self,
        function: Any,
        *,
        robot: str = "robot",
        joints: Pattern = "*",
        bodies: Pattern | None = None,
        sites: Pattern | None = None,
        size: int | None = None,
        memory: int = 0,
        lasting: int = 0,
        **parameters: Any,
    ) -> None:
        self.function = function
        self.robot = robot
        self.joints, self.bodies, self.sites = joints, bodies, sites
        self.size = size
        self.memory, self.lasting = memory, lasting
        self.parameters = parameters

    @property
    def function_name(self) -> str:
        """Name of the function, for tables and errors."""
        return str(getattr(self.function, "__name__", None) or getattr(self.function, "key", self.function))


class Reward(Term):
    """A term of the reward, a float, summed over its elements.

    Args:
        function: As for :class:`Term`.
        weight: Its factor, negative for a cost; a number of the same name in ``config.rewards`` takes its place.
        per_second: Multiply by the length of the control step [s].
        unless_terminated: The term is 0 in a step in which a termination ends the episode.
        **options: As for :class:`Term`.
    """

    def __init__(
        self,
        function: Any,
        *,
        weight: float | None = None,
        per_second: bool = False,
        unless_terminated: bool = False,
        **options: Any,
    ) -> None:
        super().__init__(function, **options)
        self.weight = weight
        self.per_second, self.unless_terminated = per_second, unless_terminated


class Metric(Term):
    """A float, summed over its elements, that is logged but not rewarded: the mean over the steps of the finished episodes.

    Args:
        function: As for :class:`Term`.
        at_end: Log the mean of the values at the last step of each finished episode instead.
        shown: Its unit, such as ``"%"``, to show it in a training's progress; None: don't show it.
        **options: As for :class:`Term`.
    """

    def __init__(self, function: Any, *, at_end: bool = False, shown: str | None = None, **options: Any) -> None:
        super().__init__(function, **options)
        self.at_end, self.shown = at_end, shown


class Termination(Term):
    """A bool that ends the episode if it is true for any element; the number of episodes that each ends is logged by its name.

    Args:
        function: As for :class:`Term`.
        time_out: Truncate the episode, as the clock does: the value of its last state still includes future rewards.
        **options: As for :class:`Term`.
    """

    def __init__(self, function: Any, *, time_out: bool = False, **options: Any) -> None:
        super().__init__(function, **options)
        self.time_out = time_out


class Command(Term):
    """A command to the policy: numbers in ``episodes.memory`` that the function draws at a reset and when their time is up.

    Args:
        function: Has the parameter ``command`` (first column), and draws with ``stream``.
        names: Of the numbers, in order.
        units: Of the numbers; ``"1"`` by default.
        ranges: Least and greatest value of each in training, for the policy's contract; by default the function's parameters of
            the same names.
        seconds: Least and greatest duration of a command [s].
        update: A term that is called in every later step, for example to turn a heading into a turning velocity.
        hidden: Count of further numbers after those, which the policy does not see.
        **options: As for :class:`Term`.
    """

    def __init__(
        self,
        function: Any,
        *,
        names: Sequence[str],
        units: Sequence[str] | None = None,
        ranges: Mapping[str, tuple[float, float]] | None = None,
        seconds: tuple[float, float] | float = (10.0, 10.0),
        update: Term | None = None,
        hidden: int = 0,
        **options: Any,
    ) -> None:
        super().__init__(function, **options)
        self.names = _several(names)
        self.units = _several(units) if units is not None else ("1",) * len(self.names)
        self.ranges = dict(ranges or {})
        self.seconds = (float(seconds), float(seconds)) if isinstance(seconds, int | float) else seconds
        self.update = update
        self.hidden = hidden


class Event(Term):
    """A change of a world: at its reset (``reset``), at intervals (``interval``), or once (``startup``).

    Args:
        function: As for :class:`Term`; it draws with ``stream``.
        when: ``"reset"``, ``"interval"`` or ``"startup"``.
        seconds: For an interval: least and greatest time between two events [s].
        **options: As for :class:`Term`.
    """

    def __init__(
        self,
        function: Any,
        *,
        when: Literal["reset", "interval", "startup"] = "reset",
        seconds: tuple[float, float] | None = None,
        **options: Any,
    ) -> None:
        super().__init__(function, **options)
        self.when, self.seconds = when, seconds


class Curriculum(Term):
    """A rule that is applied to a world between the end of its episode and its reset, such as a terrain's next level.

    It keeps its state in ``lasting`` numbers.
    """


class Observation(Term):
    """A term of an observation group: float or vector, one for each element, in order.

    The value is offset by noise, clipped, scaled, delayed, and stacked with those of the steps before, in this order.

    Args:
        function: As for :class:`Term`.
        scale: Factor: one number, one for each column, or a mapping from patterns of the columns' names.
        offset: Subtracted from the value before all else, as ``scale``; ``"default"``: each joint's default position.
        noise: Half the width of uniform noise [the value's unit]; or ``("normal", deviation)``.
        clip: Least and greatest value [the value's unit].
        delay: Greatest delay [control steps]; each episode draws its own, from 0 or from the first of two numbers.
        history: Number of observed steps, including the present one; the oldest comes first.
        names: Of the columns; by default the term's name, with those of its elements and of its axes.
        unit: Of the value.
        kind: ``"measured"``, ``"command"`` or ``"previous_action"``; by default it follows from the parameters.
        **options: As for :class:`Term`.
    """

    def __init__(
        self,
        function: Any,
        *,
        scale: Any = 1.0,
        offset: Any = 0.0,
        noise: float | tuple[str, float] = 0.0,
        clip: tuple[float, float] | None = None,
        delay: int | tuple[int, int] = 0,
        history: int = 1,
        names: Sequence[str] | None = None,
        unit: str | Sequence[str] = "1",
        kind: Literal["measured", "command", "previous_action"] | None = None,
        **options: Any,
    ) -> None:
        super().__init__(function, **options)
        self.scale, self.offset = scale, offset
        pair: Any = noise if isinstance(noise, tuple | list) and len(noise) == 2 else ("uniform", noise)
        self.noise_kind: str = pair[0]
        self.noise: float = pair[1]
        self.clip = clip
        self.delay = (0, delay) if isinstance(delay, int) else delay
        self.history = history
        self.names = tuple(names) if names is not None else None
        self.unit, self.kind = unit, kind


@dataclass(frozen=True)
class Image:
    """An observation group with a camera's images: bytes, shape ``(worlds, channels * frames, height, width)``.

    Args:
        sensor: Name of a :class:`worker.simulation.sensors.camera.CameraSensor` among the declaration's sensors.
    """

    sensor: str


class Action(Term):
    """The effect of a part of the policy's output: the function's ``value`` is ``offset + scale * action``, of the clipped action.

    Args:
        function: Has the parameters ``joint`` and ``value``, and writes ``worlds.controls``; or, for a frame that a ``DifferentialIK``
            moves, ``index``, ``value`` and one of the type ``IkArrays``.
        scale: Factor: one number, or a mapping from patterns of joints or columns.
        offset: One number, a mapping from patterns of joints, or ``"default"``: each joint's default position.
        clip: Least and greatest action; None: no clipping.
        kind: ``"effort"``, ``"position"`` or ``"velocity"``, for a function of your own: by default, what the joints' actuators take.
        unit: Of the actuator's input; by default that of ``kind`` on a revolute or prismatic joint, such as N m or N.
        **options: As for :class:`Term`.
    """

    def __init__(
        self,
        function: Any,
        *,
        scale: Any = 1.0,
        offset: Any = 0.0,
        clip: tuple[float, float] | None = (-1.0, 1.0),
        kind: Literal["effort", "position", "velocity"] | None = None,
        unit: str | None = None,
        **options: Any,
    ) -> None:
        super().__init__(function, **options)
        self.scale, self.offset, self.clip, self.kind, self.unit = scale, offset, clip, kind, unit


class Choice(Term):
    """A discrete action, one of several choices: the function's parameter ``choice`` is its number, from 0.

    Args:
        function: Has the parameter ``choice``, and writes ``worlds.controls``.
        names: Of the choices.
        targets: What each choice asks of the robot's joints, in the order of the names; the policy contract tells a robot of them.
        **options: As for :class:`Term`.
    """

    def __init__(
        self, function: Any, *, names: Sequence[str], targets: Sequence[Sequence[Target]] = (), **options: Any
    ) -> None:
        super().__init__(function, **options)
        self.names = tuple(names)
        self.targets = tuple(map(tuple, targets)) or ((),) * len(self.names)


NAME = re.compile(r"[a-z][a-z0-9_]*")
"""Valid names of terms: a name becomes part of a place, of a column of the log and of a variable in a kernel."""


@dataclass(frozen=True)
class Declaration:
    """A whole task, by named terms. Names are of small letters, digits and underscores.

    Raises:
        ValueError: A name can't be one, or an entry is of another type.
    """

    actions: Mapping[str, Action] | Choice
    """Terms of the action, in order; or one discrete choice."""
    observations: Mapping[str, Observation] | Mapping[str, Mapping[str, Observation] | Image]
    """Terms of the policy's observations, in order; or of several groups: ``policy``, and ``critic`` for privileged observations.
    Without a group ``critic``, the critic sees the policy's observations without noise and delay. An :class:`Image` group must also be
    named in the configuration's ``further_groups``; if ``policy`` is an image, ``critic`` has the terms."""
    rewards: Mapping[str, Reward]
    """Terms of the reward, at least one; each has a weight, beside it or in ``config.rewards``."""
    terminations: Mapping[str, Termination] = field(default_factory=dict)
    """Ends of an episode other than the clock."""
    commands: Mapping[str, Command] = field(default_factory=dict)
    """Commands to the policy."""
    events: Mapping[str, Event] = field(default_factory=dict)
    """Changes at a reset, at intervals and at startup, in the order of the terms."""
    curricula: Mapping[str, Curriculum | Adaptive] = field(default_factory=dict)
    """Rules that make a world harder or easier, and numbers that adapt to the policy's performance."""
    metrics: Mapping[str, Metric] = field(default_factory=dict)
    """Further logged values."""
    sensors: Mapping[str, Any] = field(default_factory=dict)
    """Sensors by the names that terms use."""
    randomize: Mapping[str, Any] = field(default_factory=dict)
    """Quantities of the model that differ from world to world."""
    success: str | None = None
    """Criterion for a successful evaluated episode: the name of a metric, which must be greater than 0 in its last step, or of the
    termination that must have ended it. None: only the clock ended it, which means nothing in a task without terminations."""

    def __post_init__(self) -> None:
        for section, kind in SECTIONS.items():
            entries = self.groups if section == "observations" else {"": getattr(self, section)}
            if section == "actions" and isinstance(self.actions, Choice):
                continue
            for group, terms in entries.items():
                for name, term in terms.items():
                    where = ".".join(filter(None, (section, group, str(name))))
                    _check_name(where, name)
                    if isinstance(term, Image):
                        raise ValueError(
                            f'observations.{name}: an Image is a group of its own; write observations={{"policy": {{…}}, "{name}": …}}'
                        )
                    if section == "curricula" and isinstance(term, Adaptive):
                        continue
                    if not isinstance(term, kind):
                        raise ValueError(f"{where}: expected {_a(kind.__name__)}, found {a_type(term)}")
        for name, entry in self.randomize.items():
            if not isinstance(entry, Randomize):
                raise ValueError(f"randomize.{name}: expected a Randomize, found {a_type(entry)}")
        for name, sensor in self.sensors.items():
            _check_name(f"sensors.{name}", name)
            if isinstance(sensor, type) or not all(hasattr(sensor, each) for each in ("arrays_type", "rows", "build")):
                raise ValueError(
                    f"sensors.{name}: expected a sensor, such as ContactSensor(...), found {a_type(sensor)}"
                )
        if "policy" not in self.groups:
            existing = ", ".join(self.observations)
            if "policy" in self.images:
                raise ValueError(
                    f"observations: the policy sees an image alone; give a group critic of terms besides (available: {existing})"
                )
            raise ValueError(f"observations: there is no group policy, only {existing}")

    @property
    def by_group(self) -> Mapping[str, Mapping[str, Observation] | Image]:
        """The terms or the camera of each observation group; observations without groups are those of the policy."""
        observations: Mapping[str, Any] = self.observations
        nested = bool(observations) and all(isinstance(each, Mapping | Image) for each in observations.values())
        return observations if nested else {"policy": observations}

    @property
    def groups(self) -> Mapping[str, Mapping[str, Observation]]:
        """The terms of each observation group that has terms; if the policy sees an image, the critic's terms are under ``policy``."""
        groups = {name: each for name, each in self.by_group.items() if isinstance(each, Mapping)}
        if "policy" in self.images and "critic" in groups:
            groups = {"policy": groups.pop("critic"), **groups}
        return groups

    @property
    def images(self) -> Mapping[str, Image]:
        """The observation groups that are images."""
        return {name: each for name, each in self.by_group.items() if isinstance(each, Image)}


SECTIONS: Mapping[str, type[Term]] = {
    "actions": Action,
    "observations": Observation,
    "rewards": Reward,
    "terminations": Termination,
    "commands": Command,
    "events": Event,
    "curricula": Curriculum,
    "metrics": Metric,
}
"""The sections of a declaration and the types of their terms."""


def _check_name(where: str, name: Any) -> None:
    if not isinstance(name, str) or not NAME.fullmatch(name):
        raise ValueError(f"{where}: a name has small letters, digits and underscores, and begins with a letter")


def _several(names: Any) -> tuple[Any, ...]:
    """Names as a tuple; a single name becomes a tuple of one."""
    return tuple(names) if isinstance(names, Sequence) and not isinstance(names, str) else (names,)


def a_type(value: Any) -> str:
    """The type of a value, for errors: ``"an Event"``; of a class: ``"the class Event"``."""
    return f"the class {value.__name__}" if isinstance(value, type) else _a(type(value).__name__)


def _a(name: str) -> str:
    return f"{'an' if name[0] in 'AEIOUaeiou' else 'a'} {name}"
