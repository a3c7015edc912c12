"""Values of the job YAML: durations, sizes, names, and their errors."""

from __future__ import annotations

import re
from collections.abc import Mapping
from importlib.metadata import entry_points
from typing import Annotated

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict

from orchestrator.domain.errors import SpecError
from orchestrator.domain.excerpts import excerpt
from shared_store.contract.entry_points import clash
from shared_store.contract.error_text import shown, unknown_task
from shared_store.volume.layout import NAME

_UNITS = {"s": 1, "m": 60, "h": 3600, "d": 86400}
_BYTES = {"KiB": 2**10, "MiB": 2**20, "GiB": 2**30, "TiB": 2**40, "KB": 10**3, "MB": 10**6, "GB": 10**9, "TB": 10**12}


class Section(BaseModel):
    """A mapping of the job YAML with keys of its own."""

    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)


def _duration(value: object) -> object:
    """``90s``, ``45m``, ``2h``, ``1d`` or a number of seconds → seconds."""
    if isinstance(value, str):
        match = re.fullmatch(r"(\d+(?:\.\d+)?)\s*([smhd])", value.strip())
        if not match:
            raise ValueError("expected a duration such as 90s, 45m, 2h or 1d")
        return float(match[1]) * _UNITS[match[2]]
    return value


def seconds_of(option: str, text: str | None) -> float | None:
    """Seconds of an option such as ``--retention 90d``. Raises SpecError."""
    if text is None:
        return None
    try:
        return float(str(_duration(text)))
    except ValueError as error:
        raise SpecError(f"{option} {text}: {error}") from None


def _mebibytes(value: object) -> object:
    """``512MiB``, ``4GiB`` or a number of MiB → whole MiB."""
    if isinstance(value, str):
        match = re.fullmatch(r"(\d+(?:\.\d+)?)\s*([KMGT]i?B)", value.strip())
        if not match:
            raise ValueError("expected an amount of memory such as 512MiB or 4GiB")
        return int(float(match[1]) * _BYTES[match[2]] / 2**20)
    return value


def _bytes(value: object) -> object:
    """``64MiB``, ``1GiB`` or a number of bytes → whole bytes."""
    if isinstance(value, str):
        match = re.fullmatch(r"(\d+(?:\.\d+)?)\s*([KMGT]i?B)", value.strip())
        if not match:
            raise ValueError("expected a size such as 64MiB or 1GiB")
        return int(float(match[1]) * _BYTES[match[2]])
    return value


def _run_name(value: str) -> str:
    if not NAME.fullmatch(value):
        raise ValueError("expected letters, digits, '.', '_' and '-', starting with a letter or digit, at most 128")
    return value


def _job_name(value: str) -> str:
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_-]{0,99}", value):
        raise ValueError("expected letters, digits, '_' and '-', starting with a letter or digit, at most 100")
    return value


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
        raise ValueError("expected a text without a zero byte")
    return value


def known_tasks() -> list[str]:
    """Names of the installed tasks, from the entry-point group ``muster.tasks``; nothing is imported."""
    return sorted({entry.name for entry in entry_points(group="muster.tasks")})


Duration = Annotated[float, BeforeValidator(_duration)]
Memory = Annotated[int, BeforeValidator(_mebibytes)]
Size = Annotated[int, BeforeValidator(_bytes)]
RunName = Annotated[str, AfterValidator(_run_name)]
JobName = Annotated[str, AfterValidator(_job_name)]
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
