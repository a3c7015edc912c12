"""The text of errors about values of a job's YAML: one line, with the same words at the submission and from a rank."""

from __future__ import annotations

import difflib
import re
import reprlib
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

_NAMES = {"int": "an integer", "float": "a number", "string": "a string", "bool": "true or false"}
_NAMES |= dict.fromkeys(("list", "tuple"), "a list")
_NAMES |= dict.fromkeys(("dict", "mapping", "model", "dataclass"), "an object")
"""The first words of pydantic's types of errors, and what they expect."""

OF_PLUGIN = "if a plug-in provides it, install the plug-in's package"
"""What to do where a name is unknown that a plug-in may bring: a task, a command, a section of a job."""

Path = tuple[str | int, ...]

_MOST_PLACES = 5
"""Further wrong places that an error names."""


class Refused(ValueError):
    """A value can't be used.

    Args:
        path: Keys to it, starting at the configuration.
        words: One line: what was expected, what was found.
    """

    def __init__(self, path: Path, words: str) -> None:
        super().__init__(": ".join(filter(None, (".".join(map(str, path)), words))))
        self.path, self.words = path, words


def path_of(problem: Mapping[str, Any]) -> Path:
    """Keys to the wrong value; a :class:`Refused` knows more of them than pydantic.

    Args:
        problem: One of ``pydantic.ValidationError.errors()``.
    """
    cause = problem.get("ctx", {}).get("error")
    return (*problem["loc"], *(cause.path if isinstance(cause, Refused) else ()))


def explain(problem: Mapping[str, Any]) -> str:
    """The expected and the found value, in words.

    Args:
        problem: One of ``pydantic.ValidationError.errors()``.
    """
    kind, found = problem["type"], problem.get("input")
    if kind == "missing":
        return "is required"
    if kind == "value_error":
        cause = problem["ctx"]["error"]
        if isinstance(cause, Refused):
            return cause.words
        text = str(cause)
        return text if not text.startswith("expected") or isinstance(found, dict) else f"{text}, found {shown(found)}"
    if kind == "literal_error":
        return f"expected {problem['ctx']['expected']}, found {shown(found)}"
    if kind == "float_type" and (power := re.fullmatch(r"([+-]?\d+)(?:\.(\d*))?[eE]([+-]?)(\d+)", str(found))):
        written = f"{power[1]}.{power[2] or 0}e{power[3] or '+'}{power[4]}"  # a form that YAML 1.1 reads as a number
        return f"expected a number, found a string ({shown(found)}); in YAML it is written {written}"
    if kind == "too_short" and problem["ctx"]["min_length"] == 1:
        # tuples are settings such as the widths of layers
        what = "number" if problem["ctx"]["field_type"] == "Tuple" else "item"
        return f"expected at least one {what}, found {shown(list(found) if isinstance(found, tuple) else found)}"
    if kind == "finite_number":
        return f"expected a finite number, found {kind_of(found)}"
    if kind.endswith(("_type", "_parsing", "_from_float")) and (name := _NAMES.get(kind.partition("_")[0])):
        return f"expected {name}, found {kind_of(found)}"
    message = str(problem["msg"])
    return f"{message.replace('Input should be', 'expected a value', 1)}, found {shown(found)}"


def counted(count: int, noun: str, plural: str = "") -> str:
    """A count with its noun: ``1 episode``, ``100 episodes``; ``plural``: an irregular plural."""
    return f"{count} {noun if count == 1 else plural or f'{noun}s'}"


def nearest(name: object, known: Iterable[str], otherwise: str = "", cutoff: float = 0.6) -> str:
    """A hint about a name that is not in ``known``: the nearest of these, else ``otherwise``, or all of them."""
    names = list(known)
    near = difflib.get_close_matches(str(name), names, n=1, cutoff=cutoff)
    return f"did you mean {near[0]}?" if near else otherwise or f"available: {', '.join(names) or 'none'}"


def enumerated(first: Sequence[str], total: int) -> str:
    """The first of ``total`` names for a sentence, and how many more there are: ``a, b and 4 more``."""
    more = total - len(first)
    return ", ".join(first) + (f" and {more} more" if more > 0 else "")


def other_places(places: Iterable[Path], named: Path) -> str:
    """The further places that are wrong, as the end of a sentence about the ``named`` one; empty where there are none."""
    others = list(dict.fromkeys(".".join(map(str, place)) for place in places if place != named))
    first = [each[:60] for each in others[:_MOST_PLACES]]
    return f" (also wrong or missing: {enumerated(first, len(others))})" if others else ""


def unknown_iteration(run: str, iteration: object, known: Iterable[object]) -> str:
    """That a run has no checkpoint of this iteration, with those that it has."""
    return f"run {run} has no checkpoint of iteration {iteration}; available: {', '.join(map(str, known)) or 'none'}"


def unknown_task(name: str, known: Iterable[str]) -> str:
    """That no task has this name, with the nearest of the known ones."""
    return f"no task is called {shown(name)}; {nearest(name, known)} (your own: module:Class; {OF_PLUGIN})"


def kind_of(value: object) -> str:
    """The common word for the type of a value of a YAML document."""
    name = type(value).__name__
    what = f" ({shown(value)})" if isinstance(value, str | int | float) else ""
    return "nothing" if value is None else _NAMES.get("string" if name == "str" else name, name) + what


def shown(value: object, most: int = 60) -> str:
    """``repr(value)`` in about ``most`` characters, at a cost that does not grow with the value."""
    brief = reprlib.Repr()
    brief.maxlevel, brief.maxstring, brief.maxother, brief.maxlong = 3, most, most, most
    text = repr(value[:most]) if isinstance(value, str) else brief.repr(value)
    return text if len(text) <= most else text[: most - 3] + "…"
