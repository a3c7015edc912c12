"""The inputs of a term's function, read from its annotations.

A term's function is a ``@wp.func`` with annotated parameters and result. Each parameter receives its value by type or name:

- ``world: int``, always;
- by type: ``WorldArrays``, ``EpisodeArrays``, ``BodyArrays``, ``TerrainArrays``, ``RobotArrays`` (of the term's robot; further
  ones are named by a keyword of the parameter's own name), and the structs of sensors (named the same way);
- ``joint``, ``body``, ``site``, ``index`` (int): the function is called for each element of the term's selection;
- ``action: int``: the function is called for each action;
- ``stream: wp.uint32``: a random generator of its own;
- ``command: int``: the first column of the command that the keyword ``command`` names (in a command's own function: its own);
- ``memory: int``, ``lasting: int``: the first column of the term's own numbers in ``episodes.memory`` and ``episodes.lasting``
  (:func:`worker.tasks.declare.term_needs.needs` beside the function, or the term's ``memory=`` and ``lasting=``, give their count);
- ``value: float`` (actions): offset + scale * action; ``choice: int`` (choices): number of the choice;
- ``terminated: bool`` (rewards, metrics): whether a termination ended the episode in this step;
- ``seconds: float``: the length of a control step;
- every other parameter of type float, int, bool or a vector: a number of the declaration.
"""

from __future__ import annotations

import ast
import inspect
import textwrap
import typing
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, TypeGuard

import warp as wp

from worker.simulation.episodes import EpisodeArrays
from worker.simulation.robot_arrays import BodyArrays, RobotArrays
from worker.simulation.worlds import WorldArrays

Element = Literal["joint", "body", "site", "index", "action"]
ELEMENTS: tuple[Element, ...] = ("joint", "body", "site", "index", "action")
"""Parameters over whose values a function is called."""
FILLED = ("world", "stream", "memory", "lasting", "value", "choice", "terminated", "seconds")
"""Parameters that the compiler fills by their names."""
WIDTHS: Mapping[Any, int] = {
    float: 1,
    int: 1,
    bool: 1,
    wp.float32: 1,
    wp.int32: 1,
    wp.vec2: 2,
    wp.vec3: 3,
    wp.vec4: 4,
    wp.quat: 4,
    wp.transform: 7,
}
"""Numbers in a value of each type that a parameter or a result may have."""


@dataclass(frozen=True)
class Signature:
    """Parameters and result of a function.

    Attributes:
        name: Of the function.
        parameters: Type of each parameter, in order.
        defaults: Of the parameters that have one.
        returns: Type of the result, None without one.
    """

    name: str
    parameters: Mapping[str, Any]
    defaults: Mapping[str, Any]
    returns: Any

    @property
    def element(self) -> Element | None:
        """The parameter over whose values the function is called."""
        return next((name for name in ELEMENTS if name in self.parameters), None)

    @property
    def width(self) -> int:
        """Numbers of one result."""
        return WIDTHS[self.returns] if self.returns is not None else 0

    def numbers(self, *, taken: frozenset[str] = frozenset()) -> dict[str, Any]:
        """Type of each parameter that is a number of the declaration, except those in ``taken``."""
        return {
            name: kind
            for name, kind in self.parameters.items()
            if kind in WIDTHS and name not in (*FILLED, *ELEMENTS, "command", *taken)
        }


def is_warp(function: Any) -> TypeGuard[wp.Function]:
    """Whether a term's function is a Warp function; else it is one of torch."""
    return isinstance(function, wp.Function)


def signature(function: Any) -> Signature:
    """Parameters and result of a Warp function.

    Raises:
        ValueError: A parameter or the result has no type, or a type that a term can't have.
    """
    name = function.func.__qualname__
    try:
        hints = typing.get_type_hints(function.func)
    except NameError as error:
        raise ValueError(f"{name}: an annotation names what its module does not have: {error}") from error
    found = inspect.signature(function.func).parameters
    parameters: dict[str, Any] = {}
    for parameter in found:
        if parameter not in hints:
            raise ValueError(f"{name}: its parameter {parameter} has no type; annotate it, such as {parameter}: float")
        kind = hints[parameter]
        if kind not in WIDTHS and not is_struct(kind) and kind is not wp.uint32:
            raise ValueError(
                f"{name}: its parameter {parameter} is {shown_type(kind)}, which a term can't have; "
                "use float, int, bool, a vector, or a struct of a sensor"
            )
        parameters[parameter] = kind
    if "world" not in parameters:
        raise ValueError(
            f"{name}: a term's function has a parameter world: int; it has {', '.join(parameters) or 'none'}"
        )
    if several := [each for each in ELEMENTS if each in parameters][1:]:
        raise ValueError(f"{name}: a term is applied to one kind of element; it has also a parameter {several[0]}")
    returns = hints.get("return")
    if returns is type(None):
        returns = None
    if returns is not None and returns not in WIDTHS:
        raise ValueError(f"{name}: its result is {shown_type(returns)}; a term gives float, bool or a vector")
    defaults = {key: value.default for key, value in found.items() if value.default is not inspect.Parameter.empty}
    return Signature(name, parameters, defaults, returns)


STRUCTS: Mapping[Any, str] = {WorldArrays: "worlds", EpisodeArrays: "episodes", BodyArrays: "bodies"}
"""Structs that all terms share, and their names in a kernel."""


def is_struct(kind: Any) -> bool:
    """Whether a parameter's type is a Warp struct."""
    return type(kind).__name__ == "Struct" and hasattr(kind, "vars")


def is_robot(kind: Any) -> bool:
    """Whether a parameter takes the arrays of a robot."""
    return kind is RobotArrays


def shown_type(kind: Any) -> str:
    """A type as a user writes it."""
    return str(getattr(kind, "key", None) or getattr(kind, "__name__", None) or kind)


def reads_poses(function: Any) -> bool:
    """Whether a Warp function, or one that it calls, may read poses or velocities of ``BodyArrays``.

    Centres of mass relative to their bodies do not change in a step: a function that reads nothing else needs no update of bodies.
    If the source leaves it open, as with another name for the same arrays, the answer is yes.
    """
    hints = typing.get_type_hints(function.func)
    names = {name for name, kind in hints.items() if kind is BodyArrays}
    return bool(names) and _reads(function.func, names)


def _reads(function: Any, names: set[str]) -> bool:
    """Whether a function does more with ``names`` than read their centres of mass, or pass them to functions that do no more."""
    try:
        tree = ast.parse(textwrap.dedent(inspect.getsource(function)))
    except (OSError, TypeError):
        return True
    scope = inspect.getclosurevars(function)
    known = {**scope.globals, **scope.nonlocals}
    harmless: set[ast.expr] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and node.attr == "coms":
            harmless.add(node.value)
        elif (
            isinstance(node, ast.Call)
            and isinstance(node.func, ast.Name)
            and is_warp(called := known.get(node.func.id))
            and called.func is not None  # as of a function of Warp's own
        ):
            parameters = list(inspect.signature(called.func).parameters)
            handed = {name: value for name, value in zip(parameters, node.args, strict=False)}
            handed |= {keyword.arg: keyword.value for keyword in node.keywords if keyword.arg}
            ours = {name for name, value in handed.items() if isinstance(value, ast.Name) and value.id in names}
            if not ours or not _reads(called.func, ours):
                harmless |= {handed[name] for name in ours}
    used = [node for node in ast.walk(tree) if isinstance(node, ast.Name) and node.id in names]
    return any(node not in harmless for node in used)
