"""A term bound to a robot's model: which elements it is called for, and what each of its parameters is in a kernel."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from shared_store.wording import nearest
from worker.simulation.robot_view import RobotView
from worker.tasks.declaration import Pattern, Term
from worker.tasks.functions import STRUCTS, WIDTHS, Signature, is_robot, is_struct, is_warp, shown_type, signature
from worker.tasks.numbers import EXPRESSIONS, Numbers


@dataclass
class Bound:
    """A term and all that a kernel has to know of it.

    Attributes:
        place: Section and name, such as ``rewards.track_linear``.
        term: As declared.
        signature: Of its function; None of a torch term.
        elements: What its function is called with, one call each; None: it has no such parameter.
        element_names: Of the elements.
        arguments: What each of its parameters is in the kernel; the others (``world``, elements) are variables of the kernel.
        memory: First column of its own memory, -1 where it has none.
        external: First column of what a torch term gives, -1 where it is none.
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
    """Binds terms one after the other, and collects what they need.

    Args:
        views: The robots and objects by name.
        sensors: The sensors as declared, by name.
        actions: Names of the actions, in order; filled before terms are bound that want them.
        has_terrain: Whether the task has a terrain.

    Attributes:
        numbers: All numbers of the bound terms.
        structs: Variables of structs in the kernels, and their types.
        commands: First column in memory of each command, by name.
        memory: Columns of ``episodes.memory`` that are given away.
        lasting: Columns of ``episodes.lasting`` that are given away.
        external: Columns of torch terms.
        indices: Elements that no range of whole numbers gives, one selection after the other.
    """

    def __init__(self, views: Mapping[str, RobotView], sensors: Mapping[str, Any], has_terrain: bool) -> None:
        self.views, self.sensors, self.has_terrain = views, sensors, has_terrain
        self.numbers = Numbers()
        self.structs: dict[str, Any] = {}
        self.commands: dict[str, int] = {}
        self.actions: list[str] = []
        self.indices: list[int] = []
        self.memory = 0
        self.lasting = 0
        self.external = 0

    def bind(self, place: str, term: Term, *, element: bool = True, own: Mapping[str, str] | None = None) -> Bound:
        """Bind a term.

        Args:
            place: Section and name.
            term: As declared.
            element: Whether its function may be called for several elements.
            own: Parameters that the kernel fills itself, and how.

        Raises:
            ValueError: The function or its parameters do not fit, in one line that names the place.
        """
        if not is_warp(term.function):
            return self._bind_torch(place, term)
        try:
            found = signature(term.function)
        except ValueError as error:
            raise ValueError(f"{place}: {error}") from error
        bound = Bound(place, term, found, width=max(found.width, 1))
        if found.element:
            if not element:
                raise ValueError(
                    f"{place}: {found.name} has a parameter {found.element}, which there is nothing for here"
                )
            bound.elements, bound.element_names = self._elements(place, term, found)
        given = dict(found.defaults) | term.parameters
        known = [name for name, kind in found.parameters.items() if is_named(name, kind, found)]
        for name in term.parameters:
            if name not in known:
                raise ValueError(
                    f"{place}: {found.name} has no parameter {name}; {nearest(name, known) or 'it takes none'}"
                )
        for name, kind in found.parameters.items():
            bound.arguments[name] = self._argument(bound, name, kind, given, own or {})
        return bound

    def _bind_torch(self, place: str, term: Term) -> Bound:
        if not callable(term.function):
            raise ValueError(
                f"{place}: {term.function!r} is no function; a term is a @wp.func, or a Python function of the task that gives a tensor"
            )
        bound = Bound(place, term, None, width=term.size or 1, external=self.external)
        self.external += bound.width
        return bound

    def _rows(self, place: str, term: Term, found: Signature) -> list[str]:
        """The columns of the first sensor that a term reads; one without a sensor is called once."""
        for name, kind in found.parameters.items():
            if is_struct(kind) and kind not in STRUCTS and not is_robot(kind) and shown_type(kind) != "TerrainArrays":
                sensor = self._sensor(place, name, kind, term.parameters.get(name))
                rows: list[str] = self.sensors[sensor].rows(self.views)
                return rows
        return ["0"]

    def _elements(self, place: str, term: Term, found: Signature) -> tuple[list[int], list[str]]:
        element = found.element
        assert element is not None
        if element == "index":
            names = self._rows(place, term, found) if term.size is None else [str(index) for index in range(term.size)]
            return list(range(len(names))), names
        if element == "action":
            return list(range(len(self.actions))), list(self.actions)
        view = self._view(place, term.robot)
        return find(
            place, view, element, getattr(term, {"joint": "joints", "body": "bodies", "site": "sites"}[element])
        )

    def _view(self, place: str, name: str) -> RobotView:
        if name not in self.views:
            raise ValueError(f"{place}: the task has no robot or object {name!r}; {nearest(name, list(self.views))}")
        return self.views[name]

    def _argument(self, bound: Bound, name: str, kind: Any, given: Mapping[str, Any], own: Mapping[str, str]) -> str:
        place, term = bound.place, bound.term
        if name in own:
            return own[name]
        if name == "world" or name == (bound.signature and bound.signature.element):
            return name
        if name == "seconds":
            return "seconds"
        if name == "memory":
            if term.memory < 1:
                raise ValueError(f"{place}: {term.function_name} keeps numbers; say how many with memory=")
            bound.memory, self.memory = self.memory, self.memory + term.memory
            return str(bound.memory)
        if name == "lasting":
            if term.lasting < 1:
                raise ValueError(f"{place}: {term.function_name} keeps lasting numbers; say how many with lasting=")
            first, self.lasting = self.lasting, self.lasting + term.lasting
            return str(first)
        if name == "command":
            return str(self._command(place, given.get("command")))
        if is_struct(kind):
            return self._struct(bound, name, kind, given)
        if kind not in WIDTHS:
            raise ValueError(f"{place}: {term.function_name} has a parameter {name}, which there is nothing for here")
        if name in ("stream", "value", "choice", "terminated", "joint", "body", "site", "index", "action"):
            raise ValueError(f"{place}: {term.function_name} has a parameter {name}, which there is nothing for here")
        if name not in given:
            raise ValueError(f"{place}: {term.function_name} needs {name}={shown_type(kind)}")
        first = self.numbers.add(f"{place}.{name}", given[name], WIDTHS[kind])
        return EXPRESSIONS[kind].format(*range(first, first + WIDTHS[kind]))

    def _command(self, place: str, name: Any) -> int:
        if name is None and len(self.commands) == 1:
            return next(iter(self.commands.values()))
        if name not in self.commands:
            known = nearest(str(name), list(self.commands)) if self.commands else "the task declares none"
            wanted = "say which command it is of, with command=" if name is None else f"there is no command {name!r}"
            raise ValueError(f"{place}: {wanted}; {known}")
        return self.commands[name]

    def _struct(self, bound: Bound, name: str, kind: Any, given: Mapping[str, Any]) -> str:
        place = bound.place
        if kind in STRUCTS:
            variable = STRUCTS[kind]
        elif is_robot(kind):
            robots = [key for key, each in bound.signature.parameters.items() if is_robot(each)]  # type: ignore[union-attr]
            robot = given.get(name, bound.term.robot if name == robots[0] else None)
            if robot is None:
                raise ValueError(f"{place}: say which robot or object {name} is, with {name}=")
            self._view(place, robot)
            variable = f"robot_{robot}"
        elif shown_type(kind) == "TerrainArrays":
            if not self.has_terrain:
                raise ValueError(f"{place}: {bound.term.function_name} needs a terrain, and the task stands on none")
            variable = "terrain"
        else:
            variable = f"sensor_{self._sensor(place, name, kind, given.get(name))}"
        self.structs[variable] = kind
        return variable

    def _sensor(self, place: str, parameter: str, kind: Any, name: Any) -> str:
        """The sensor that a parameter is given: the named one, or the only one of its kind."""
        fitting = [key for key, each in self.sensors.items() if each.arrays_type is kind]
        if name is None and len(fitting) == 1:
            return fitting[0]
        if name not in self.sensors:
            there = f"there are {', '.join(fitting)}" if fitting else "the task declares none"
            raise ValueError(f"{place}: {parameter}= names a sensor that gives {shown_type(kind)}; {there}")
        if name not in fitting:
            gives = shown_type(self.sensors[name].arrays_type)
            raise ValueError(f"{place}: the sensor {name} gives {gives}, and {parameter} takes {shown_type(kind)}")
        return str(name)


def find(place: str, view: RobotView, element: str, pattern: Pattern | None) -> tuple[list[int], list[str]]:
    """The elements of a robot that fit a pattern, as a function takes them, and their names.

    Raises:
        ValueError: None fits, or none was named.
    """
    if pattern is None:
        plural = {"body": "bodies"}.get(element, f"{element}s")
        raise ValueError(f"{place}: say which {plural} it is for, with {plural}=")
    try:
        if element == "joint":
            found = view.find_joints(pattern)
            return found, [view.joint_names[each] for each in found]
        if element == "body":
            found = view.find_bodies(pattern)
            return [view.bodies[each] for each in found], [view.body_names[each] for each in found]
        found = view.find_sites(pattern)
        return found, [view.site_names[each] for each in found]
    except ValueError as error:
        raise ValueError(f"{place}: {error}") from error


def is_named(name: str, kind: Any, found: Signature) -> bool:
    """Whether a declaration may give a parameter: a number, a command, a robot, a sensor."""
    if name == "command":
        return True
    if is_struct(kind):
        return kind not in STRUCTS
    return name in found.numbers()
