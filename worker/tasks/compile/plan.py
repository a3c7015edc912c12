"""The plan of a task, a declaration bound to its robots: the place of every number and the name of every column."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from shared_store.contract.error_text import nearest, shown
from worker.settings.task import TaskConfig
from worker.simulation.actuators import Input
from worker.simulation.patterns import resolve
from worker.simulation.robot_view import RobotView
from worker.tasks.compile.acting import check_action, check_driven
from worker.tasks.compile.binding import Binder, Bound
from worker.tasks.compile.configured import deviations
from worker.tasks.compile.contract import described
from worker.tasks.compile.declaration_checks import (
    check_command,
    check_observation,
    check_randomized,
    check_result,
    placed,
)
from worker.tasks.compile.images import cameras
from worker.tasks.compile.numbers import are_times, flat, in_order, is_amount
from worker.tasks.declare.declaration import (
    Adaptive,
    Choice,
    Command,
    Curriculum,
    Declaration,
    Event,
    Observation,
    Term,
)

JUDGED = {"terminated": "terminated"}
DRAWN = {"stream": "stream"}
"""Parameters that are variables of the kernel, for terms of some sections."""
AXES = {2: ("x", "y"), 3: ("x", "y", "z"), 4: ("x", "y", "z", "w")}


@dataclass
class Column:
    """Location of the numbers that a kernel applies to the columns of a term: one for all, or one per column."""

    first: int
    each: bool

    def at(self, index: str) -> str:
        """The number of column ``index`` of the term, in a kernel."""
        return f"numbers[{self.first} + {index}]" if self.each else f"numbers[{self.first}]"


@dataclass
class Noise:
    """Noise on the columns of a term: half the width of a uniform one, or the deviation of a normal one."""

    amounts: Column
    normal: bool


@dataclass
class Seen:
    """An observation term in its group.

    Attributes:
        bound: The term.
        names: Of the columns of one step.
        first: Its first column in the group.
        scale, offset, clip: Numbers; None: not applied.
        noises: Its own noise, and that of ``config.randomize.observation_noise``.
        past: First column of the memory for its delay, -1 without one.
    """

    bound: Bound
    names: list[str]
    first: int
    scale: Column | None
    offset: Column | None
    noises: list[Noise]
    clip: int | None
    past: int

    @property
    def term(self) -> Observation:
        """As declared."""
        term = self.bound.term
        assert isinstance(term, Observation)
        return term

    @property
    def size(self) -> int:
        """Columns in the group, with its history."""
        return len(self.names) * self.term.history


@dataclass
class Driven:
    """An action term: its first action, the numbers of its joints, and what it writes to their actuators."""

    bound: Bound
    first: int
    scale: Column
    offset: Column
    clip: int | None
    kind: Input


@dataclass
class Timed:
    """A command or an event, with the update of a command in each step.

    ``countdown`` is the column in memory of the control steps that are left, ``seconds`` the first number of the bounds of its duration
    [s]; -1: it is not repeated.
    """

    bound: Bound
    countdown: int = -1
    seconds: int = -1
    update: Bound | None = None


class KernelPlan:
    """The contents of a task's kernels.

    Args:
        declaration: The task's terms.
        config: Its configuration: weights, ``numbers``.
        views: Its robots and objects by name.
        sensors: The sensors as declared, by name.
        has_terrain: Whether it has a terrain.

    Raises:
        ValueError: A term does not fit, in one line with its place.
    """

    def __init__(
        self,
        declaration: Declaration,
        config: TaskConfig,
        views: Mapping[str, RobotView],
        sensors: Mapping[str, Any],
        has_terrain: bool = False,
    ) -> None:
        self.declaration, self.config, self.views = declaration, config, views
        self.binder = binder = Binder(views, sensors, has_terrain)
        self.numbers = binder.numbers
        self.numbers.others = [
            f"randomize.{name}.{own}" for name, each in declaration.randomize.items() for own in each.places
        ]
        self.past = 0
        self.choice: Bound | None = None
        self.driven: list[Driven] = []
        self._reserve_commands()
        self._bind_actions()
        self.commands = [self._command(name, term) for name, term in declaration.commands.items()]
        self.weights = self._weigh(config)
        self.rewards = [self._bind("rewards", name, declaration.rewards[name], own=JUDGED) for name in self.weights]
        self.metrics = [self._bind("metrics", name, term, own=JUDGED) for name, term in declaration.metrics.items()]
        self.terminations = [self._bind("terminations", name, term) for name, term in declaration.terminations.items()]
        if "time_out" in declaration.terminations:
            raise ValueError("terminations.time_out: the clock's own has this name; choose another")
        rules = {name: term for name, term in declaration.curricula.items() if isinstance(term, Curriculum)}
        self.curricula = [self._bind("curricula", name, term, own=DRAWN) for name, term in rules.items()]
        self.adaptive = {name: term for name, term in declaration.curricula.items() if isinstance(term, Adaptive)}
        self.events = [self._event(name, term) for name, term in declaration.events.items()]
        self.groups = {name: self._group(name, terms) for name, terms in declaration.groups.items()}
        self.images = cameras(declaration, config, sensors, views)
        for place, value in config.numbers.items():
            if place.startswith("randomize."):  # the built task sets it
                check_randomized(declaration.randomize, place, value, "config.numbers")
            else:
                self.numbers.set(place, value, "config.numbers")
        for place, points in config.curriculum.items():
            if "." in place:
                self._check_course(place, [value for _, value in points], "config.curriculum")
            elif place != "level" and place not in self.weights:
                near = nearest(place, ["level", *self.weights])
                raise ValueError(f"config.curriculum.{place}: there is no such term; {near}")
        for name, rule in self.adaptive.items():
            self._check_course(rule.place, [rule.start, rule.end], f"curricula.{name}")
        self._add_noise(config.randomize.observation_noise)
        if critic := self._exact():
            self.groups["critic"] = critic
        self.external = 0
        self._place_torch_terms()
        self.success, self.external_success = self._success(declaration.success)

    @property
    def names(self) -> tuple[str, ...]:
        """Name of each column of the policy's group; earlier steps end in ``_1`` (the step before), ``_2``, …"""
        return tuple(name for seen in self.groups["policy"] for name in stacked(seen))

    @property
    def actions(self) -> tuple[str, ...]:
        """Name of each action, or choice."""
        term = self.choice.term if self.choice else None
        return term.names if isinstance(term, Choice) else tuple(self.binder.actions)

    @property
    def terms(self) -> Iterable[Bound]:
        """Every bound term."""
        yield from (each.bound for each in self.driven)
        yield from [self.choice] if self.choice else []
        for timed in (*self.commands, *self.events):
            yield from [timed.bound, *([timed.update] if timed.update else [])]
        yield from (*self.rewards, *self.metrics, *self.terminations, *self.curricula)
        for group in self.groups.values():
            yield from (seen.bound for seen in group)

    def _bind(self, section: str, name: str, term: Term, **options: Any) -> Bound:
        bound = self.binder.bind(f"{section}.{name}", term, **options)
        check_result(bound, section)
        return bound

    def in_warp(self, section: str) -> list[Bound]:
        """The rewards, metrics or terminations that are Warp functions."""
        bounds: list[Bound] = getattr(self, section)
        return [bound for bound in bounds if bound.signature is not None]

    @property
    def in_torch(self) -> list[Bound]:
        """The torch terms, each once: the observations, then the judged ones."""
        seen = {seen.bound.place: seen.bound for group in self.groups.values() for seen in group}
        return [
            bound
            for bound in (*seen.values(), *self.rewards, *self.metrics, *self.terminations)
            if bound.signature is None
        ]

    def _place_torch_terms(self) -> None:
        """Give the results of torch terms their columns; only those of observations are part of the kernels' source."""
        for bound in self.in_torch:
            bound.external, self.external = self.external, self.external + bound.width

    def _success(self, name: str | None) -> tuple[str | None, int]:
        """Whether the last step was a success, as an expression of the kernel, or as a column of the torch terms.

        Raises:
            ValueError: The name is unknown.
        """
        if name is None:
            return None, -1
        bound = next((each for each in (*self.metrics, *self.terminations) if each.name == name), None)
        if bound is None:
            known = [*self.declaration.metrics, *self.declaration.terminations]
            raise ValueError(f"success: no metric and no termination is called {name}; {nearest(name, known)}")
        if bound.signature is None:
            return None, bound.external
        if bound in self.metrics:
            return f"total_{len(self.in_warp('rewards')) + self.in_warp('metrics').index(bound)} > 0.0", -1
        return f"ended_{self.in_warp('terminations').index(bound)}", -1

    def _check_course(self, place: str, values: list[float], where: str) -> None:
        """Refuse an unknown place, or a value that is invalid for any of its numbers."""
        for value in values:
            if place.startswith("randomize."):
                check_randomized(self.declaration.randomize, place, value, where, fill=True)
            else:
                self.numbers.check_filled(place, value, where)

    def _reserve_commands(self) -> None:
        """Reserve the columns of all commands first, so that any term may name any of them."""
        for name, term in self.declaration.commands.items():
            check_command(f"commands.{name}", term)
            self.binder.reserve_command(name, term)

    def _bind_actions(self) -> None:
        declared = self.declaration.actions
        if isinstance(declared, Choice):
            own = {"choice": "int(episodes.actions[world, 0])"}
            self.choice = self._bind("actions", "choice", declared, element=False, own=own)
            check_driven([self.choice], self.views, self.binder.sensors)
            return
        if not declared:
            raise ValueError("actions: there is none; a policy needs at least one")
        for name, term in declared.items():
            place, first = f"actions.{name}", len(self.binder.actions)
            bound = self._bind("actions", name, term, own={"value": "value"})
            kind = check_action(bound, self.views, self.binder.sensors)
            self.binder.actions += bound.element_names
            offset = self._default(place, bound) if term.offset == "default" else term.offset
            clip = self.numbers.add(f"{place}.clip", term.clip, 2, in_order) if term.clip is not None else None
            scale = self._columns(f"{place}.scale", term.scale, bound.element_names)
            self.driven.append(
                Driven(bound, first, scale, self._columns(f"{place}.offset", offset, bound.element_names), clip, kind)
            )
        check_driven([driven.bound for driven in self.driven], self.views, self.binder.sensors)

    def _default(self, place: str, bound: Bound) -> list[float]:
        """The default positions of a term's joints."""
        if not bound.takes("joint"):
            raise ValueError(
                f'{place}: offset="default" is for terms of joints; {bound.term.function_name} has no parameter joint'
            )
        return [self.views[bound.term.robot].defaults[joint] for joint in bound.elements or ()]

    def _columns(self, place: str, value: Any, names: list[str]) -> Column:
        """A value for all columns, for each, or by patterns of their names."""
        if isinstance(value, Mapping):
            value = by_pattern(place, value, names)
        if isinstance(value, int | float):
            return Column(self.numbers.add(place, value, 1), False)
        return Column(self.numbers.add(place, value, len(names)), True)

    def _command(self, name: str, term: Command) -> Timed:
        first, place = self.binder.commands[name], f"commands.{name}"
        own = {"command": str(first), **DRAWN}
        bound = self._bind("commands", name, term, element=False, own=own)
        update = None
        if term.update is not None:
            update = self._bind("commands", f"{name}.update", term.update, element=False, own=own)
            self.binder.check_command(update, name)
        countdown = first + self.binder.visible[name] + self.binder.hidden[name]
        seconds = self.numbers.add(f"{place}.seconds", term.seconds, 2, are_times)
        return Timed(bound, countdown, seconds, update)

    def _weigh(self, config: TaskConfig) -> dict[str, float]:
        """The weight of each reward: that of ``config.rewards``, or else the one beside the term.

        Terms come in the order of the settings that name them, then in that of the declaration.
        """
        supplied, declared = config.rewards, self.declaration.rewards
        for name in supplied:
            if name not in declared:
                near = nearest(name, declared) if declared else "it declares none"
                raise ValueError(f"config.rewards.{name}: the task has no term {shown(name)}; {near}")
        if not declared:
            raise ValueError("rewards: there is none; declare one, such as Reward(terms.alive, weight=1.0)")
        names = [*config.default_weights, *(name for name in declared if name not in config.default_weights)]
        found = {name: supplied.get(name, declared[name].weight) for name in names}
        for name, weight in found.items():
            if weight is None:
                raise ValueError(f"rewards.{name}: it has no weight; give it one, such as Reward(…, weight=-1.0)")
            flat(f"rewards.{name}.weight", weight, 1)
        return {name: float(weight) for name, weight in found.items() if weight is not None}

    def _event(self, name: str, term: Event) -> Timed:
        place = f"events.{name}"
        bound = self._bind("events", name, term, own=DRAWN)
        if term.when not in ("reset", "interval", "startup"):
            raise ValueError(f"{place}: when is {term.when!r}; it is reset, interval or startup")
        if term.when != "interval":
            return Timed(bound)
        if term.seconds is None:
            raise ValueError(f"{place}: an interval needs seconds=(least, greatest), above 0")
        column, self.binder.memory = self.binder.memory, self.binder.memory + 1
        return Timed(bound, column, self.numbers.add(f"{place}.seconds", term.seconds, 2, are_times))

    def _group(self, group: str, terms: Mapping[str, Observation]) -> list[Seen]:
        if not terms:
            raise ValueError(f"observations.{group}: the group has no terms")
        seen: list[Seen] = []
        first = 0
        prefix = "observations" if group == "policy" else f"observations.{group}"
        for name, term in terms.items():
            seen.append(self._seen(prefix, name, term, first, group == "policy"))
            first += seen[-1].size
        names = [name for each in seen for name in each.names]
        doubled = [name for name in names if names.count(name) > 1]
        if doubled:
            raise ValueError(f"{prefix}: two columns are called {doubled[0]}; give one of the terms names=")
        return seen

    def _seen(self, section: str, name: str, term: Observation, first: int, noisy: bool) -> Seen:
        place = f"{section}.{name}"
        bound = self._bind(section, name, term, own=DRAWN)
        names = column_names(place, name, term, bound)
        check_observation(place, term, len(names))
        greatest = term.delay[1]
        past = -1
        if greatest:
            past, self.past = self.past, self.past + 1 + greatest * len(names)
        scale = self._columns(f"{place}.scale", term.scale, names) if term.scale != 1.0 else None
        value = self._default(place, bound) if term.offset == "default" else term.offset
        offset = (
            self._columns(f"{place}.offset", value, names) if isinstance(value, list | tuple) or value != 0.0 else None
        )
        noises = []
        if noisy and term.noise != 0.0:
            amount = self.numbers.add(f"{place}.noise", term.noise, 1, is_amount)
            noises.append(Noise(Column(amount, False), term.noise_kind == "normal"))
        clip = self.numbers.add(f"{place}.clip", term.clip, 2, in_order) if term.clip is not None else None
        return Seen(bound, names, first, scale, offset, noises, clip, past)

    def _add_noise(self, noise: float | Mapping[str, float]) -> None:
        """Add the noise of the configuration to the policy's measured terms."""
        if not noise:
            return
        columns = [column for seen in self.groups["policy"] for column in described(self, seen)]
        with placed("config.randomize.observation_noise"):
            found = deviations(noise, columns)
        for seen in self.groups["policy"]:
            mine, found = found[: len(seen.names)], found[len(seen.names) :]
            if any(mine):
                place = f"randomize.observation_noise.{seen.bound.name}"
                seen.noises.append(Noise(Column(self.numbers.add(place, mine, len(mine)), True), True))

    def _exact(self) -> list[Seen] | None:
        """The critic's terms if none are declared: the policy's without noise and delay; None: these equal the policy's."""
        policy = self.groups["policy"]
        if "critic" in self.groups or not any(seen.noises or seen.past >= 0 for seen in policy):
            return None
        return [dataclasses.replace(seen, noises=[], past=-1) for seen in policy]


def column_names(place: str, name: str, term: Observation, bound: Bound) -> list[str]:
    """The names of a term's columns: as given, or made of the names of the term, its elements and its axes."""
    if term.names is not None:
        if len(term.names) != bound.columns:
            raise ValueError(f"{place}: {len(term.names)} names for {bound.columns} columns")
        return list(term.names)
    elements = [
        f"{element}_{name}" if not element.isdigit() else f"{name}_{element}" for element in bound.element_names
    ]
    stems = elements if bound.elements is not None else [name]
    if bound.signature is None and bound.width > 1:
        return [f"{name}_{column}" for column in range(bound.width)]
    axes = AXES.get(bound.width, tuple(map(str, range(bound.width))))
    return stems if bound.width == 1 else [f"{stem}_{axis}" for stem in stems for axis in axes]


def stacked(seen: Seen) -> list[str]:
    """Names of all columns of a term with its history, the oldest first."""
    backs = range(seen.term.history - 1, -1, -1)
    return [f"{name}_{back}" if back else name for back in backs for name in seen.names]


def by_pattern(place: str, values: Mapping[str, float], names: list[str]) -> list[float]:
    """One value for each name; the first pattern that fits counts.

    Raises:
        ValueError: A pattern fits no name, or a name has no pattern.
    """
    with placed(place):
        found: list[float | None] = resolve(names, values, "column")
    lacking = [name for name, value in zip(names, found, strict=True) if value is None]
    if lacking:
        raise ValueError(f"{place}: no pattern fits {lacking[0]}; add one, such as '*'")
    return flat(place, found, len(names))
