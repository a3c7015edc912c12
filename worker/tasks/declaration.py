"""What a declared task is made of: named terms for actions, observations, rewards, terminations, commands, events and curricula.

A term is a small Warp function with annotated parameters, see :mod:`worker.tasks.functions`. Its numbers are data: changing one
compiles nothing, and a job's YAML changes them under ``train.config.numbers`` by their place, such as
``rewards.track_linear.std``.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from worker.tasks.randomize import Randomize

Pattern = str | Sequence[str]
"""Names of joints, bodies or sites: one or several, with ``*`` for any letters, in the order of the model."""


class Term:
    """A function, what it is applied to, and its numbers.

    Args:
        function: A ``@wp.func``; or a Python function ``(task, **parameters) -> torch.Tensor``, whose launches are captured.
        robot: Name of the robot or object that ``RobotArrays`` and patterns are of.
        joints: Where the function has a parameter ``joint``: which joints.
        bodies: Where it has a parameter ``body``: which bodies.
        sites: Where it has a parameter ``site``: which sites.
        size: Where it has a parameter ``index``: it is called with 0 to ``size - 1``, by default for each column of its sensor; of a
            torch term: the columns that it gives, 1 by default.
        memory: How many numbers of its own it has in ``episodes.memory``, from the column that its parameter ``memory`` says; they are
            0 when an episode begins.
        lasting: As ``memory``, in ``episodes.lasting``, where they survive episodes.
        **parameters: Its numbers (float, or a tuple for a vector), and by name the sensors, commands and further robots that its
            parameters of these kinds want.
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
    """A term of the reward, a float, summed over its elements; its weight is in ``config.rewards`` under its name.

    Args:
        function: As for :class:`Term`.
        per_second: Multiply by the length of the control step [s].
        unless_terminated: The term is 0 in a step in which a termination ends the episode.
        **options: As for :class:`Term`.
    """

    def __init__(
        self, function: Any, *, per_second: bool = False, unless_terminated: bool = False, **options: Any
    ) -> None:
        super().__init__(function, **options)
        self.per_second, self.unless_terminated = per_second, unless_terminated


class Metric(Term):
    """A float, summed over its elements, that is logged and rewards nothing: its mean over the steps of the episodes that ended.

    Args:
        function: As for :class:`Term`.
        at_end: It is the mean over the episodes that ended, of each what its last step says.
        shown: Its unit, such as ``"%"``, where it is to be seen in a training's progress; None: it is not.
        **options: As for :class:`Term`.
    """

    def __init__(self, function: Any, *, at_end: bool = False, shown: str | None = None, **options: Any) -> None:
        super().__init__(function, **options)
        self.at_end, self.shown = at_end, shown


class Termination(Term):
    """A bool, true where it is for any element, that ends the episode; how often each did is logged by its name.

    Args:
        function: As for :class:`Term`.
        time_out: It cuts the episode off as the clock does: what would have come after counts for the value of its last state.
        **options: As for :class:`Term`.
    """

    def __init__(self, function: Any, *, time_out: bool = False, **options: Any) -> None:
        super().__init__(function, **options)
        self.time_out = time_out


class Command(Term):
    """What the policy is asked to do: numbers in ``episodes.memory`` that the function draws, at a reset and when their time is over.

    Args:
        function: Has the parameter ``command`` (first column), and draws with ``stream``.
        names: Of the numbers, in order.
        units: Of the numbers; ``"1"`` by default.
        ranges: Least and greatest value of each in training, for the policy's contract; by default the numbers of the function that
            are called like them.
        seconds: Least and greatest time for which a command holds [s].
        update: A term that is called in every step after that, such as one that turns a heading into a turning velocity.
        hidden: Further numbers behind those, which the policy is not told.
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
    """Something that happens to a world: when it is placed afresh (``reset``), now and then (``interval``), once (``startup``).

    Args:
        function: As for :class:`Term`; it draws with ``stream``.
        when: ``"reset"``, ``"interval"`` or ``"startup"``.
        seconds: Of an interval: least and greatest time between two [s].
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
    """A rule that is applied to a world whose episode ended, before it is placed afresh, such as a terrain's next level.

    It keeps what it needs in ``lasting`` numbers.
    """


@dataclass(frozen=True)
class Adaptive:
    """A number that follows how well the policy does: the same in all worlds of all ranks, and part of a run's state.

    Before each iteration it goes one step from ``start`` towards ``end`` where the mean of the episodes that ended last is above
    ``above``, and one step back where it is below ``below``. An evaluation of a checkpoint has it as the training had.

    Args:
        place: Of the number, such as ``events.push.speed``; of several numbers, all of them.
        start: Its value at first.
        end: Its last value.
        steps: Number of steps from one to the other.
        above: From which mean on it goes on.
        below: Under which mean it goes back; None: never.
        of: Whether the mean is that of the ``"return"`` or of the ``"length"`` [steps].
    """

    place: str
    start: float
    end: float
    steps: int = 20
    above: float = 0.0
    below: float | None = None
    of: Literal["return", "length"] = "return"

    def __post_init__(self) -> None:
        if self.steps < 1:
            raise ValueError(f"Adaptive of {self.place}: steps is {self.steps}; use 1 or more")
        if self.below is not None and self.below >= self.above:
            raise ValueError(
                f"Adaptive of {self.place}: below is {self.below}, which must be less than above, {self.above}"
            )
        if self.of not in ("return", "length"):
            raise ValueError(f"Adaptive of {self.place}: of is {self.of!r}; it is return or length")

    def after(self, step: float, reward: float | None, episode_length: float | None) -> float:
        """The step, from 0 to :attr:`steps`, that follows ``step``."""
        mean = reward if self.of == "return" else episode_length
        if mean is None:
            return step
        moved = step + (mean > self.above) - (self.below is not None and mean < self.below)
        return min(max(moved, 0.0), float(self.steps))

    def value(self, step: float) -> float:
        """The number at a step."""
        return self.start + (self.end - self.start) * step / self.steps


class Observation(Term):
    """A term of an observation group: float or vector, one for each element, in order.

    The value is offset by noise, clipped, scaled, delayed, and stacked with those of the steps before, in this order.

    Args:
        function: As for :class:`Term`.
        scale: Factor; one number, one for each column, or a mapping from patterns of the columns' names.
        offset: Subtracted from the value before all else, as ``scale``; ``"default"``: each joint's default position.
        noise: Half the width of uniform noise [the value's unit]; or ``("normal", deviation)``.
        clip: Least and greatest value [the value's unit].
        delay: Greatest number of control steps by which it comes late; each episode draws its own, from 0, or from the first of two.
        history: Number of steps seen, the present one among them; the oldest comes first.
        names: Of the columns; by default the term's name, with those of its elements and of its axes.
        unit: Of the value.
        kind: Whether it is ``"measured"``, a ``"command"``, or the ``"previous_action"``; by default what its parameters tell.
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
        is_pair = isinstance(noise, tuple | list) and len(noise) == 2
        self.noise_kind, self.noise = noise if is_pair else ("uniform", noise)  # type: ignore[misc]
        self.clip = clip
        self.delay = (0, delay) if isinstance(delay, int) else delay
        self.history = history
        self.names = tuple(names) if names is not None else None
        self.unit, self.kind = unit, kind


@dataclass(frozen=True)
class Image:
    """An observation group that is what a camera sees: bytes, shape ``(worlds, channels * frames, height, width)``.

    Args:
        sensor: Name of a :class:`worker.simulation.sensors.camera.CameraSensor` among the declaration's sensors.
    """

    sensor: str


class Action(Term):
    """What a part of the policy's output does: ``offset + scale * action``, of the clipped action, is the function's ``value``.

    Args:
        function: Has the parameters ``joint`` and ``value``, and writes ``worlds.controls``; or, of a frame that a ``DifferentialIK``
            moves, ``index``, ``value`` and one of the type ``IkArrays``.
        scale: Factor; one number, or a mapping from patterns of joints or columns.
        offset: One number, a mapping from patterns of joints, or ``"default"``: each joint's default position.
        clip: Least and greatest action; None: the policy's output as it is.
        kind: What the actuator's input is: an ``"effort"``, a ``"position"`` or a ``"velocity"``.
        unit: Of the actuator's input; by default what ``kind`` has on a joint that turns or slides, such as N m or N.
        **options: As for :class:`Term`.
    """

    def __init__(
        self,
        function: Any,
        *,
        scale: Any = 1.0,
        offset: Any = 0.0,
        clip: tuple[float, float] | None = (-1.0, 1.0),
        kind: Literal["effort", "position", "velocity"] = "effort",
        unit: str | None = None,
        **options: Any,
    ) -> None:
        super().__init__(function, **options)
        self.scale, self.offset, self.clip, self.kind, self.unit = scale, offset, clip, kind, unit


class Choice(Term):
    """The action is one of several: the function's parameter ``choice`` is its number, from 0.

    Args:
        function: Has the parameter ``choice``, and writes ``worlds.controls``.
        names: Of the choices.
        **options: As for :class:`Term`.
    """

    def __init__(self, function: Any, *, names: Sequence[str], **options: Any) -> None:
        super().__init__(function, **options)
        self.names = tuple(names)


NAME = re.compile(r"[a-z][a-z0-9_]*")
"""What a term may be called: it becomes part of a place, of a column of the log and of a variable in a kernel."""


@dataclass(frozen=True)
class Declaration:
    """A whole task, by named terms. Names are of small letters, digits and underscores.

    Raises:
        ValueError: A name can't be one, or an entry is of another type.
    """

    actions: Mapping[str, Action] | Choice
    """Terms of the action, in order; or the one choice that the action is."""
    observations: Mapping[str, Observation] | Mapping[str, Mapping[str, Observation] | Image]
    """Terms of what the policy sees, in order; or of several groups: ``policy``, and ``critic`` for what only the simulation knows.
    Without a group ``critic``, it sees what the policy sees, without noise and delay. A group that is an :class:`Image` is named in the
    configuration's ``further_groups``, too; where ``policy`` is one, ``critic`` has the terms."""
    rewards: Mapping[str, Reward]
    """By the names of ``config.rewards``, all of them."""
    terminations: Mapping[str, Termination] = field(default_factory=dict)
    """What ends an episode besides the clock."""
    commands: Mapping[str, Command] = field(default_factory=dict)
    """What the policy is asked to do."""
    events: Mapping[str, Event] = field(default_factory=dict)
    """What happens at a reset, at intervals, at startup, in this order of the terms."""
    curricula: Mapping[str, Curriculum | Adaptive] = field(default_factory=dict)
    """Rules by which a world becomes harder or easier, and numbers that follow how well the policy does."""
    metrics: Mapping[str, Metric] = field(default_factory=dict)
    """What is logged besides."""
    sensors: Mapping[str, Any] = field(default_factory=dict)
    """Sensors by the names by which terms ask for them."""
    randomize: Mapping[str, Any] = field(default_factory=dict)
    """Quantities of the model that differ from world to world."""
    success: str | None = None
    """When an evaluated episode is a success: the name of a metric, which must be greater than 0 in its last step, or of the termination
    that must have ended it. None: where only the clock ended it, which means nothing in a task without terminations."""

    def __post_init__(self) -> None:
        for section, kind in SECTIONS.items():
            entries = self.groups if section == "observations" else {"": getattr(self, section)}
            if section == "actions" and isinstance(self.actions, Choice):
                continue
            for group, terms in entries.items():
                for name, term in terms.items():
                    where = ".".join(filter(None, (section, group, str(name))))
                    if not isinstance(name, str) or not NAME.fullmatch(name):
                        raise ValueError(
                            f"{where}: a term's name has small letters, digits and underscores, and begins with a letter"
                        )
                    if isinstance(term, Image):
                        raise ValueError(
                            f'observations.{name}: an Image is a group of its own; write observations={{"policy": {{…}}, "{name}": …}}'
                        )
                    if section == "curricula" and isinstance(term, Adaptive):
                        continue
                    if not isinstance(term, kind):
                        raise ValueError(f"{where}: expected {_a(kind.__name__)}, found {_a(type(term).__name__)}")
        for name, entry in self.randomize.items():
            if not isinstance(entry, Randomize):
                raise ValueError(f"randomize.{name}: expected a Randomize, found {_a(type(entry).__name__)}")
        for name, sensor in self.sensors.items():
            if not isinstance(name, str) or not NAME.fullmatch(name):
                raise ValueError(
                    f"sensors.{name}: a name has small letters, digits and underscores, and begins with a letter"
                )
            if not all(hasattr(sensor, each) for each in ("arrays_type", "rows", "build")):
                raise ValueError(
                    f"sensors.{name}: expected a sensor, such as ContactSensor(...), found {_a(type(sensor).__name__)}"
                )
        if "policy" not in self.groups:
            there = ", ".join(self.observations)
            if "policy" in self.images:
                raise ValueError(
                    f"observations: the policy sees an image alone; give a group critic of terms besides (there are: {there})"
                )
            raise ValueError(f"observations: there is no group policy, only {there}")

    @property
    def _nested(self) -> bool:
        """Whether the observations are in several groups."""
        return bool(self.observations) and all(isinstance(each, Mapping | Image) for each in self.observations.values())

    @property
    def groups(self) -> Mapping[str, Mapping[str, Observation]]:
        """The terms of each observation group that has terms; where the policy sees an image, those of the critic are under ``policy``."""
        if not self._nested:
            return {"policy": self.observations}  # type: ignore[dict-item]
        groups = {name: each for name, each in self.observations.items() if isinstance(each, Mapping)}
        if "policy" in self.images and "critic" in groups:
            groups = {"policy": groups.pop("critic"), **groups}
        return groups

    @property
    def images(self) -> Mapping[str, Image]:
        """The observation groups that are images."""
        return (
            {name: each for name, each in self.observations.items() if isinstance(each, Image)} if self._nested else {}
        )


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
"""The sections of a declaration and what their terms are."""

TorchFunction = Callable[..., Any]


def _several(names: Any) -> tuple[Any, ...]:
    """Names as a tuple; one that stands alone is one."""
    return tuple(names) if isinstance(names, Sequence) and not isinstance(names, str) else (names,)


def _a(name: str) -> str:
    return f"{'an' if name[0] in 'AEIOUaeiou' else 'a'} {name}"
