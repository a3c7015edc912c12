"""Documents of the store as dataclasses: parsed without a library, and refused in one line that names the place of the error."""

from __future__ import annotations

import dataclasses
import types
from collections.abc import Mapping
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from shared_store.contract.error_text import kind_of, nearest, shown


class DocumentError(ValueError):
    """A document is invalid; one line that names the place of the error."""


def parse(kind: Any, value: Any, where: str) -> Any:
    """Convert a value of a JSON document to the type of a field.

    Args:
        kind: A dataclass, or a type of its fields: dataclass, number, text, literal, tuple, mapping, ``X | None``.
        value: Plain values.
        where: Name of the document, followed by the keys to the value.

    Raises:
        DocumentError: The value does not fit; one line with its keys, and for an unknown name the nearest one.
    """
    origin, arguments = get_origin(kind), get_args(kind)
    if dataclasses.is_dataclass(kind):
        return _parse_fields(kind, value, where)
    if kind is Any:
        return value
    if origin is Literal:
        if value not in arguments:
            raise DocumentError(f"{where}: expected one of {', '.join(map(repr, arguments))}, found {shown(value)}")
        return value
    if origin in (Union, types.UnionType):
        if value is None and types.NoneType in arguments:
            return None
        return value if isinstance(value, str) and str in arguments else parse(arguments[0], value, where)
    if origin is tuple:
        if arguments[-1] is Ellipsis and isinstance(value, list):
            arguments = (arguments[0],) * len(value)
        if not isinstance(value, list) or len(value) != len(arguments):
            raise DocumentError(f"{where}: expected a list of {len(arguments)}, found {shown(value)}")
        return tuple(
            parse(each, item, f"{where}.{i}") for i, (each, item) in enumerate(zip(arguments, value, strict=True))
        )
    if origin is not None and issubclass(origin, Mapping):
        if not isinstance(value, Mapping):
            raise DocumentError(f"{where}: expected an object, found {kind_of(value)}")
        return {str(name): parse(arguments[1], each, f"{where}.{name}") for name, each in value.items()}
    allowed = (int, float) if kind is float else kind
    if not isinstance(value, allowed) or (isinstance(value, bool) and kind is not bool):
        names = {float: "a number", int: "an integer", str: "a string", bool: "true or false"}
        raise DocumentError(f"{where}: expected {names[kind]}, found {shown(value)}")
    return float(value) if kind is float else value


def _parse_fields(kind: Any, value: Any, where: str) -> Any:
    if not isinstance(value, Mapping):
        raise DocumentError(f"{where}: expected an object, found {kind_of(value)}")
    hints = get_type_hints(kind)
    fields = {field.name: field for field in dataclasses.fields(kind)}
    for name in value:
        if name not in fields:
            raise DocumentError(f"{where}: unknown key {shown(name)}; {nearest(name, fields)}")
    values = {}
    for name, field in fields.items():
        if name in value:
            values[name] = parse(hints[name], value[name], f"{where}.{name}" if ": " in where else f"{where}: {name}")
        elif field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING:
            raise DocumentError(f"{where}: {name} is missing")
    return kind(**values)
