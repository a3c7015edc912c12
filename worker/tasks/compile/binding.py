"""The binding of a term to a robot's model: its elements, and the value of each of its parameters in a kernel."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from dataclasses import dataclass, field
from math import isfinite
from typing import Any

from shared_store.contract.error_text import nearest, shown
from worker.simulation.robot_view import RobotView
from worker.simulation.sensors.height_scan import HeightScanArrays
from worker.tasks import terms
from worker.tasks.compile.declaration_checks import placed
from worker.tasks.compile.numbers import EXPRESSIONS, Numbers, stays
from worker.tasks.declare.declaration import Command, Pattern, Term
from worker.tasks.declare.functions import (
    STRUCTS,
    WIDTHS,
    Signature,
    is_robot,
    is_struct,
    is_warp,
    shown_type,
    signature,
)
from worker.tasks.declare.term_needs import Needs, needs_of

_PLURALS = {"joint": "joints", "body": "bodies", "site": "sites"}
"""The option of a term that selects elements of a kind."""


@dataclass
class Bound:
    """A term, with all that a kernel needs to call it.

    Attributes:
        place: Section and name, such as ``rewards.track_linear``.
        term: As declared.
        signature: Of its function; None for a torch term.
        elements: The elements that its function is called with, one call each; None: it has no such parameter.
        element_names: Of the elements.
        arguments: Its parameters as expressions of the kernel; the others (``world``, elements) are variables of the kernel.
        memory: First column of its own memory, -1 without any.
        external: First column of a torch term's result, -1 for a Warp function.
        chosen: The elements that a torch function takes, by parameter: ``joints``, ``bodies`` or ``sites``.
        width: Numbers of one result.
    """

    place: str
    term: Term
    signature: Signature | None
    elements: list[int] | None = None
    element_names: list[str] = field(default_factory=list)
    arguments: dict[str, str] = field(default_factory=dict)
    memory: int = -1
    external: int = -1
    chosen: dict[str, list[int]] = field(default_factory=dict)
    width: int = 1

    @property
    def name(self) -> str:
        """The term's own name."""
        return self.place.rpartition(".")[2]

    @property
    def columns(self) -> int:
        """Numbers of all its results."""
        return self.width * (len(self.elements) if self.elements is not None else 1)

    def takes(self, parameter: str) -> bool:
        """Whether its function has a parameter of this name."""
        return self.signature is not None and parameter in self.signature.parameters


class Binder:
    """Binds terms one by one, and collects the memory, numbers and structs that they need.

    Args:
        views: The robots and objects by name.
        sensors: The sensors as declared, by name.
        actions: Names of the actions, in order; filled before binding the terms that need them.
        has_terrain: Whether the task has a terrain.

    Attributes:
        numbers: All numbers of the bound terms.
        structs: Variables of structs in the kernels, and their types.
        commands: First column in memory of each command, by name.
        visible: Count of the numbers of each command that the policy sees.
        hidden: Count of the hidden numbers of each command, which follow those.
        memory: Number of allocated columns of ``episodes.memory``.
        lasting: Number of allocated columns of ``episodes.lasting``.
        indices: Elements that are not a range of whole numbers, one selection after the other.
    """

    def __init__(self, views: Mapping[str, RobotView], sensors: Mapping[str, Any], has_terrain: bool) -> None:
        self.views, self.sensors, self.has_terrain = views, sensors, has_terrain
        self.numbers = Numbers()
        self.structs: dict[str, Any] = {}
        self.commands: dict[str, int] = {}
        self.visible: dict[str, int] = {}
        self.hidden: dict[str, int] = {}
        self.actions: list[str] = []
        self.indices: list[int] = []
        self.memory = 0
        self.lasting = 0

    def bind(self, place: str, term: Term, *, element: bool = True, own: Mapping[str, str] | None = None) -> Bound:
        """Bind a term.

        Args:
            place: Section and name.
            term: As declared.
            element: Whether its function may be called for several elements.
            own: Parameters that the kernel itself fills, and their expressions.

        Raises:
            ValueError: The function or its parameters do not fit, in one line that names the place.
        """
        for name, least in (("size", 1), ("memory", 0), ("lasting", 0)):
            count = getattr(term, name)
            if count is not None and (isinstance(count, bool) or not isinstance(count, int) or count < least):
                raise ValueError(f"{place}: {name} is {shown(count)}; give a whole number from {least} up")
        if not is_warp(term.function):
            return self._bind_torch(place, term)
        with placed(place):
            found = signature(term.function)
        bound = Bound(place, term, found, width=max(found.width, 1))
        parameters = dict(found.defaults) | term.parameters
        if found.element:
            if not element:
                raise ValueError(
                    f"{place}: {found.name} has a parameter {found.element}, which there is nothing for here"
                )
            bound.elements, bound.element_names = self._elements(place, term, found, parameters)
        self._check_robot(bound)
        known = [name for name, kind in found.parameters.items() if is_named(name, kind, found)]
        for name in term.parameters:
            if name not in known:
                raise ValueError(
                    f"{place}: {found.name} has no parameter {name}; {nearest(name, known) or 'it takes none'}"
                )
        for name, kind in found.parameters.items():
            bound.arguments[name] = self._argument(bound, name, kind, parameters, own or {})
        return bound

    def _bind_torch(self, place: str, term: Term) -> Bound:
        if not callable(term.function):
            raise ValueError(f"{place}: {shown(term.function)} is not a function; {_function_instead(term.function)}")
        bound = Bound(place, term, None, width=term.size or 1)
        found = inspect.signature(term.function)
        for element, name in _PLURALS.items():
            if name in found.parameters and name not in term.parameters:
                view = self._view(place, term.robot)
                bound.chosen[name], _ = find(place, view, element, getattr(term, name))
            elif getattr(term, name) != ("*" if element == "joint" else None):
                raise ValueError(f"{place}: {term.function_name} has no parameter {name}; leave {name}= out")
        try:
            found.bind("the task", **term.parameters, **bound.chosen)
        except TypeError as error:
            raise ValueError(f"{place}: {term.function_name}: {error}") from error
        return bound

    def _indices(self, place: str, term: Term, found: Signature, parameters: Mapping[str, Any]) -> list[str]:
        """Names of the elements that a parameter ``index`` counts: columns of sensors, numbers of a command, or ``size`` of them."""
        needed = needs_of(term.function)
        names, what = self._counted(place, found, parameters, needed)
        if term.size is None:
            if not names:
                raise ValueError(f"{place}: say how often {found.name} is called, with size=")
            return names
        if names and not term.size <= len(names):
            raise ValueError(f"{place}: size is {term.size}, more than the {len(names)} {what}; leave size= out")
        return [str(index) for index in range(term.size)]

    def _counted(
        self, place: str, found: Signature, parameters: Mapping[str, Any], needed: Needs
    ) -> tuple[list[str], str]:
        """Names of the values of an index, and a word for what they are; none if the function does not say."""
        if needed.size:
            return [str(index) for index in range(needed.size)], f"elements of {found.name}"
        if needed.numbers:
            name = self._command_name(place, parameters.get("command"))
            return [str(index) for index in range(self.visible[name])], f"numbers of the command {name}"
        counts: dict[str, int] = {}
        names: list[str] = []
        for parameter, kind in found.parameters.items():
            if not _is_sensor(kind) or not has_columns(kind):
                continue
            if needed.columns is not None and parameter not in needed.columns:
                continue
            sensor = self._sensor(place, parameter, kind, parameters.get(parameter))
            rows: list[str] = self.sensors[sensor].rows(self.views)
            if needed.points and kind is HeightScanArrays:
                rows = self._frames_of(place, sensor, rows, needed.points, parameters)
            counts[sensor] = len(rows)
            names = names or rows
        if len(set(counts.values())) > 1:
            shown = " and ".join(f"{sensor} has {count}" for sensor, count in counts.items())
            raise ValueError(f"{place}: {found.name} needs as many columns of each of its sensors; {shown}")
        if needed.each > 1:
            return [str(index) for index in range(needed.each * len(names))], f"elements of {found.name}"
        return names, f"{'frames' if needed.points else 'columns'} of {', '.join(counts)}"

    @staticmethod
    def _frames_of(place: str, sensor: str, rows: list[str], points: str, parameters: Mapping[str, Any]) -> list[str]:
        """The frames of a height scan; each has as many columns as the number ``points`` says."""
        count = parameters.get(points)
        if isinstance(count, bool) or not isinstance(count, int) or count < 1 or len(rows) % count:
            raise ValueError(
                f"{place}: {points} is {shown(count)}, and the scan {sensor} has {len(rows)} columns; "
                "give the number of its points for each frame"
            )
        return [str(frame) for frame in range(len(rows) // count)]

    def _check_robot(self, bound: Bound) -> None:
        """Refuse a fixed root where a function moves it, and joints without the limits that it needs."""
        needed, view = needs_of(bound.term.function), self.views.get(bound.term.robot)
        purpose = f"{bound.place}: {bound.term.function_name}"
        if view is not None and needed.free_root and view.root_coordinate < 0:
            raise ValueError(f"{purpose} moves a free root, and that of {view.name} is fixed; leave the term out")
        if view is None or bound.elements is None:
            return
        if needed.ranges:
            view.need_ranges(bound.elements, purpose)
        if needed.some_ranges and not any(all(map(isfinite, view.ranges[joint])) for joint in bound.elements):
            view.need_ranges(bound.elements, purpose)
        if needed.efforts:
            view.need_efforts(bound.elements, purpose)

    def _memory(self, bound: Bound) -> int:
        """Number of values that a term keeps for itself.

        Raises:
            ValueError: Neither function nor declaration says how many, or the declaration says too few.
        """
        needed, term = needs_of(bound.term.function), bound.term
        count = needed.memory
        if needed.memory_each:
            joints = bound.takes("joint")
            values = len(self.views[term.robot].joint_names) if joints else 1 + max(bound.elements or [-1])
            count += needed.memory_each * values
        if not count and term.memory < 1:
            raise ValueError(f"{bound.place}: {term.function_name} keeps numbers; say how many with memory=")
        if 0 < term.memory < count:
            raise ValueError(
                f"{bound.place}: {term.function_name} keeps {count} numbers, and memory is {term.memory}; leave memory= out"
            )
        return max(count, term.memory)

    def _elements(
        self, place: str, term: Term, found: Signature, parameters: Mapping[str, Any]
    ) -> tuple[list[int], list[str]]:
        element = found.element
        assert element is not None
        if element == "index":
            names = self._indices(place, term, found, parameters)
            return list(range(len(names))), names
        if element == "action":
            if not self.actions:
                raise ValueError(
                    f"{place}: {found.name} is called for each action, and a choice has none; read "
                    "episodes.last_actions[world, 0] in a function of your own"
                )
            return list(range(len(self.actions))), list(self.actions)
        view = self._view(place, term.robot)
        return find(place, view, element, getattr(term, _PLURALS[element]))

    def _view(self, place: str, name: str) -> RobotView:
        if name not in self.views:
            raise ValueError(f"{place}: the task has no robot or object {name!r}; {nearest(name, list(self.views))}")
        return self.views[name]

    def _argument(
        self, bound: Bound, name: str, kind: Any, parameters: Mapping[str, Any], own: Mapping[str, str]
    ) -> str:
        place, term = bound.place, bound.term
        if name in own:
            return own[name]
        if name == "world" or name == (bound.signature and bound.signature.element):
            return name
        if name == "seconds":
            return "seconds"
        if name == "memory":
            bound.memory, self.memory = self.memory, self.memory + self._memory(bound)
            return str(bound.memory)
        if name == "lasting":
            if term.lasting < 1:
                raise ValueError(f"{place}: {term.function_name} keeps lasting numbers; say how many with lasting=")
            first, self.lasting = self.lasting, self.lasting + term.lasting
            return str(first)
        if name == "command":
            return str(self._command(bound, parameters.get("command")))
        if is_struct(kind):
            return self._struct(bound, name, kind, parameters)
        if kind not in WIDTHS:
            raise ValueError(f"{place}: {term.function_name} has a parameter {name}, which there is nothing for here")
        if name in ("stream", "value", "choice", "terminated", "joint", "body", "site", "index", "action"):
            raise ValueError(f"{place}: {term.function_name} has a parameter {name}, which there is nothing for here")
        if name not in parameters:
            raise ValueError(f"{place}: {term.function_name} needs {name}={shown_type(kind)}")
        # the divisor of a scan's columns is part of the kernel's bounds
        check = stays(parameters[name]) if name == needs_of(term.function).points else None
        first = self.numbers.add(f"{place}.{name}", parameters[name], WIDTHS[kind], check)
        return EXPRESSIONS[kind].format(*range(first, first + WIDTHS[kind]))

    def reserve_command(self, name: str, term: Command) -> None:
        """Reserve a command's columns in memory: the numbers for the policy, the hidden ones, and its countdown.

        Raises:
            ValueError: Its function draws another count of numbers, or keeps more of them hidden.
        """
        drawn, place = needs_of(term.function), f"commands.{name}"
        if drawn.command and drawn.command != len(term.names):
            raise ValueError(
                f"{place}: {term.function_name} draws {drawn.command} numbers; names= has {len(term.names)}"
            )
        if 0 < term.hidden < drawn.hidden:
            raise ValueError(
                f"{place}: {term.function_name} hides {drawn.hidden} numbers, and hidden is {term.hidden}; leave hidden= out"
            )
        steering = needs_of(term.update.function) if term.update else drawn
        self.commands[name], self.visible[name] = self.memory, len(term.names)
        self.hidden[name] = max(term.hidden, drawn.hidden, steering.hidden)
        self.memory += len(term.names) + self.hidden[name] + 1

    def _command_name(self, place: str, name: Any) -> str:
        if name is None and len(self.commands) == 1:
            return next(iter(self.commands))
        if name not in self.commands:
            known = nearest(str(name), list(self.commands)) if self.commands else "the task declares none"
            words = "say which command it is of, with command=" if name is None else f"there is no command {name!r}"
            raise ValueError(f"{place}: {words}; {known}")
        return str(name)

    def _command(self, bound: Bound, name: Any) -> int:
        found = self._command_name(bound.place, name)
        self.check_command(bound, found)
        return self.commands[found]

    def check_command(self, bound: Bound, command: str) -> None:
        """Refuse a term that reads or writes more numbers than its command has."""
        needed = needs_of(bound.term.function)
        if needed.command > self.visible[command] or needed.hidden > self.hidden[command]:
            expected = f"{needed.command} numbers" + (f" and {needed.hidden} hidden ones" if needed.hidden else "")
            found = f"{self.visible[command]}" + (f" and {self.hidden[command]}" if needed.hidden else "")
            raise ValueError(
                f"{bound.place}: {bound.term.function_name} needs a command of {expected}; {command} has {found}"
            )

    def _struct(self, bound: Bound, name: str, kind: Any, parameters: Mapping[str, Any]) -> str:
        place = bound.place
        if kind in STRUCTS:
            variable = STRUCTS[kind]
        elif is_robot(kind):
            assert bound.signature is not None
            robots = [key for key, each in bound.signature.parameters.items() if is_robot(each)]
            robot = parameters.get(name, bound.term.robot if name == robots[0] else None)
            if robot is None:
                raise ValueError(f"{place}: say which robot or object {name} is, with {name}=")
            self._view(place, robot)
            variable = f"robot_{robot}"
        elif shown_type(kind) == "TerrainArrays":
            if not self.has_terrain:
                raise ValueError(f"{place}: {bound.term.function_name} needs a terrain, and the task stands on none")
            variable = "terrain"
        else:
            variable = f"sensor_{self._sensor(place, name, kind, parameters.get(name))}"
        self.structs[variable] = kind
        return variable

    def _sensor(self, place: str, parameter: str, kind: Any, name: Any) -> str:
        """The sensor for a parameter: the named one, or the only one of its kind."""
        fitting = [key for key, each in self.sensors.items() if each.arrays_type is kind]
        if name is None and len(fitting) == 1:
            return fitting[0]
        if name not in self.sensors:
            hint = f"available: {', '.join(fitting)}" if fitting else "the task declares none"
            raise ValueError(f"{place}: {parameter}= names a sensor that gives {shown_type(kind)}; {hint}")
        if name not in fitting:
            gives = shown_type(self.sensors[name].arrays_type)
            raise ValueError(f"{place}: the sensor {name} gives {gives}, and {parameter} takes {shown_type(kind)}")
        return str(name)


def find(place: str, view: RobotView, element: str, pattern: Pattern | None) -> tuple[list[int], list[str]]:
    """The elements of a robot that fit a pattern, as indices for a function, and their names.

    Raises:
        ValueError: None fits, or none was named.
    """
    if pattern is None:
        plural = _PLURALS[element]
        raise ValueError(f"{place}: say which {plural} it is for, with {plural}=")
    with placed(place):
        if element == "joint":
            found = view.find_joints(pattern)
            return found, [view.joint_names[each] for each in found]
        if element == "body":
            found = view.find_bodies(pattern)
            return [view.bodies[each] for each in found], [view.body_names[each] for each in found]
        found = view.find_sites(pattern)
        return found, [view.site_names[each] for each in found]


def _function_instead(value: Any) -> str:
    """What a term takes instead of a value that is not a function; for the name of a function, that function."""
    known = [f"terms.{name}" for name in dir(terms) if is_warp(getattr(terms, name))]
    meant = f"terms.{value.removeprefix('terms.')}" if isinstance(value, str) else ""
    anything = "a term is a @wp.func, or a Python function of the task that gives a tensor"
    return nearest(meant, known, anything, cutoff=0.8)


def is_named(name: str, kind: Any, found: Signature) -> bool:
    """Whether a declaration may give a parameter: a number, a command, a robot, a sensor."""
    if name == "command":
        return True
    if is_struct(kind):
        return kind not in STRUCTS
    return name in found.numbers()


def _is_sensor(kind: Any) -> bool:
    """Whether a parameter is a sensor's measurement."""
    return is_struct(kind) and kind not in STRUCTS and not is_robot(kind) and shown_type(kind) != "TerrainArrays"


def has_columns(kind: Any) -> bool:
    """Whether a sensor's struct has a column for each measured element, besides the row of each world."""
    return any(getattr(each.type, "ndim", 0) > 1 for each in kind.vars.values())  # of an array, or of its annotation
