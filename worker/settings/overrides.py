"""Overrides of a task's configuration by a job's YAML (``train.config``): applied, or refused. Imported without torch."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping
from importlib.metadata import entry_points
from typing import TYPE_CHECKING, Any, TypeVar

from pydantic import BeforeValidator, TypeAdapter, ValidationError, WrapValidator
from pydantic.errors import PydanticUserError
from pydantic_core import ArgsKwargs

from shared_store.contract.error_text import Path, explain, nearest, other_places
from shared_store.contract.error_text import Refused as Refused

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

C = TypeVar("C", bound="DataclassInstance")


@functools.cache
def training_sections() -> frozenset[str]:
    """Fields with training settings, named after the installed algorithms; a job's YAML sets them in sections of their own."""
    return frozenset(point.name for point in entry_points(group="muster.settings"))


def configured(kind: type[C], overrides: Mapping[str, Any]) -> C:
    """A configuration with the overrides of a job's YAML, which are plain values.

    Where a field is itself a configuration, such as ``randomize``, a mapping changes the keys that it names.

    Args:
        kind: Its class, a dataclass with a default for each field.
        overrides: By field.

    Raises:
        Refused: A key is unknown, or a value has the wrong type or is out of range.
    """
    try:
        default = kind()
    except ValidationError as error:
        raise refused(error, (), {}) from error
    return _made(kind, default, {}, overrides, ())


def _made(kind: type[C], default: Any, values: dict[str, Any], overrides: Mapping[str, Any], where: Path) -> C:
    known = [item.name for item in dataclasses.fields(kind) if item.init and item.name not in training_sections()]
    for key, value in overrides.items():
        if key in training_sections() and not where:
            raise Refused((key,), f"not a key of {kind.__name__}; settings of {key} stand under train.{key}")
        if key not in known:
            raise Refused((*where, key), f"{kind.__name__} has no such key; {nearest(key, sorted(known))}")
        values[key] = _as(getattr(default, key), value, (*where, key))
    try:
        # as pydantic's own __init__ does; a plain dataclass that extends a pydantic one lacks it
        made: C = TypeAdapter(kind).validator.validate_python(ArgsKwargs((), values), self_instance=kind.__new__(kind))
    except ValidationError as error:
        raise refused(error, where, overrides) from error
    except (PydanticUserError, NameError) as error:
        first = str(error).partition("\n")[0]
        raise Refused(where, f"{kind.__name__} has a type that can't be checked: {first}") from error
    return made


def _as(default: Any, value: Any, where: Path) -> Any:
    """``value`` of a YAML document in the type of the default: a list may stand for a tuple, a mapping for a configuration."""
    if isinstance(default, tuple) and isinstance(value, list):
        return tuple(_as(default[0] if default else None, item, where) for item in value)
    if dataclasses.is_dataclass(default) and not isinstance(default, type) and isinstance(value, Mapping):
        present = {item.name: getattr(default, item.name) for item in dataclasses.fields(default) if item.init}
        return _made(type(default), default, present, value, where)
    return value


def refused(error: ValidationError, where: Path, overrides: Mapping[str, Any]) -> Refused:
    """The first of pydantic's errors in one line.

    Args:
        error: Of a configuration.
        where: Its keys in the document.
        overrides: Its values, by which the keys of the error are found.
    """
    problems = error.errors(include_url=False)
    first: Any = problems[0]
    found = first.get("input")
    # the message of a rule over several fields is complete; a tuple was a list in the YAML
    first["input"] = {} if isinstance(found, ArgsKwargs) else list(found) if isinstance(found, tuple) else found
    path = _keys(first["loc"], overrides)
    cause = first.get("ctx", {}).get("error")
    path, words = ((*path, *cause.path), cause.words) if isinstance(cause, Refused) else (path, explain(first))
    more = other_places((_keys(each["loc"], overrides) for each in problems), _keys(first["loc"], overrides))
    return Refused((*where, *path), f"{words}{more}")


def _keys(path: Path, value: Any) -> Path:
    """The part of ``path`` that is in the YAML; pydantic appends names of types."""
    for place, key in enumerate(path):
        inside = key in value if isinstance(value, Mapping) else isinstance(value, list) and key in range(len(value))
        if not inside:
            return path[: max(place, 1)]
        value = value[key]
    return path


def expecting(words: str) -> WrapValidator:
    """Annotation of a field: for an error in any part of its value, describe the whole expected value."""

    def check(value: Any, inner: Callable[[Any], Any]) -> Any:
        try:
            return inner(value)
        except ValidationError:
            raise ValueError(f"expected {words}") from None

    return WrapValidator(check)


def from_mapping(kind: type[Any]) -> BeforeValidator:
    """Annotation of a field that is a configuration of this kind: accept a mapping of its fields."""
    return BeforeValidator(lambda value: kind(**value) if isinstance(value, Mapping) else value)
