"""Values of the job YAML: durations, sizes, names, and their errors."""

from __future__ import annotations

import re
from collections.abc import Mapping
from importlib.metadata import entry_points
from typing import Annotated

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict

from orchestrator.domain.errors import SpecError
from orchestrator.domain.excerpts import excerpt
from orchestrator.domain.units import BYTES, SECONDS, amount
from shared_store.contract.entry_points import clash
from shared_store.contract.error_text import shown, unknown_task
from shared_store.volume.layout import NAME


class Section(BaseModel):
    """A mapping of the job YAML with keys of its own."""

    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)


_DURATION = "a duration such as 90s, 45m, 2h or 1d"


def _amount(units: Mapping[str, int], expected: str, unit: int | None = None) -> BeforeValidator:
    """Reads a text as an amount, in whole multiples of ``unit`` where that is given; numbers stay."""

    def read(value: object) -> object:
        if not isinstance(value, str):
            return value
        found = amount(value, units, expected)
        return found if unit is None else int(found / unit)

    return BeforeValidator(read)


def seconds_of(option: str, text: str | None) -> float | None:
    """Seconds of an option such as ``--retention 90d``. Raises SpecError."""
    if text is None:
        return None
    try:
        return amount(text, SECONDS, _DURATION)
    except ValueError as error:
        raise SpecError(f"{option} {text}: {error}") from None


def _name(pattern: re.Pattern[str], signs: str, most: int) -> AfterValidator:
    def check(value: str) -> str:
        if not pattern.fullmatch(value):
            raise ValueError(f"expected letters, digits, {signs}, starting with a letter or digit, at most {most}")
        return value

    return AfterValidator(check)


def task_name(value: str) -> str:
    """The name of an installed task, or ``module:Class``. Raises ValueError for another, and where two packages have one of this name."""
    points = entry_points(group="muster.tasks")
    if words := clash(points, value):
        raise ValueError(words)
    known = sorted({point.name for point in points})
    if ":" not in value and value not in known:
        raise ValueError(unknown_task(value, known))
    return value


def _environment(value: dict[str, str]) -> dict[str, str]:
    for name, text in value.items():
        if name.startswith(("AWS_BATCH", "MUSTER_")):
            raise ValueError(
                f"{excerpt(name, 60)} is reserved; names that start with AWS_BATCH or MUSTER_ are set by Muster"
            )
        if not name or "=" in name or "\0" in name + text:
            raise ValueError(f"{shown(name)} can't be set: a name has no '=', and neither name nor value a zero byte")
    return value


def _secrets(value: dict[str, str]) -> dict[str, str]:
    _environment(value)
    if name := next((name for name, reference in value.items() if not reference), None):
        raise ValueError(f"{shown(name)}: expected the name under which the controller has the value")
    return value


def _argument(value: str) -> str:
    if "\0" in value:
        raise ValueError("expected a string without a zero byte")
    return value


def known_tasks() -> list[str]:
    """Names of the installed tasks, from the entry-point group ``muster.tasks``; nothing is imported."""
    return sorted({entry.name for entry in entry_points(group="muster.tasks")})


Duration = Annotated[float, _amount(SECONDS, _DURATION)]
Memory = Annotated[int, _amount(BYTES, "an amount of memory such as 512MiB or 4GiB", 2**20)]
Size = Annotated[int, _amount(BYTES, "a size such as 64MiB or 1GiB", 1)]
RunName = Annotated[str, _name(NAME, "'.', '_' and '-'", 128)]
JobName = Annotated[str, _name(re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,99}"), "'_' and '-'", 100)]
TaskName = Annotated[str, AfterValidator(task_name)]
Environment = Annotated[dict[str, str], AfterValidator(_environment)]
Secrets = Annotated[dict[str, str], AfterValidator(_secrets)]
Argument = Annotated[str, AfterValidator(_argument)]


def place_of(path: tuple[str | int, ...], source: str, lines: Mapping[tuple[str | int, ...], int] | None) -> str:
    """File, line and key of an error, as the beginning of its message."""
    line = _line_of(path, lines or {})
    where = "--set" if line == 0 else f"{source}:{line}" if line else source
    key = ".".join(str(part) for part in path)
    return f"{where}: {key}: " if key else f"{where}: "


def _line_of(path: tuple[str | int, ...], lines: Mapping[tuple[str | int, ...], int]) -> int | None:
    for end in range(len(path), 0, -1):
        if path[:end] in lines:
            return lines[path[:end]]
    return None
