"""Help for the editor of a job's YAML: the published schema's text for a place, and the place of an error."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from orchestrator.console.submit_fields import bounds, config_schema, job_schema, plain
from orchestrator.spec import strict_yaml

SOURCE = "job.yaml"
"""Name of the text in errors."""
_PLACE = re.compile(rf"{re.escape(SOURCE)}(?::(\d+))?: (?:([\w.-]+): )?(.*)", re.DOTALL)


@dataclass(frozen=True)
class SubmissionProblem:
    """Why a job can't be submitted."""

    message: str
    key: str = ""
    """Key path, where the message names one."""
    line: int = 0
    """In the YAML, from 1; 0 where it is not known."""
    code_line: int = 0
    """In the code of a file that the YAML holds."""


def problem_of(error: str, text: str) -> SubmissionProblem:
    """An error of a spec that was read from ``text`` under the name :data:`SOURCE`."""
    found = _PLACE.fullmatch(error)
    if found is None:
        return SubmissionProblem(error)
    line, key, message = int(found[1] or 0), found[2] or "", found[3]
    inside = re.match(r"[^\s:]+:(\d+): [A-Z_]+: ", message)
    code_line = int(inside[1]) if inside and key.startswith("train.config.") else 0
    return SubmissionProblem(message, key, _line_of_code(text, key, code_line) or line, code_line)


def _line_of_code(text: str, key: str, code_line: int) -> int:
    """The line of the YAML on which a line of its code stands; 0 where the code is not written out as a block."""
    if not code_line:
        return 0
    try:
        _, lines = strict_yaml.load(text)
    except strict_yaml.YamlError:
        return 0
    start = lines.get((*key.split("."), "text"), 0)
    return start + code_line if start and text.splitlines()[start - 1].rstrip().endswith(("|", "|-", "|+")) else 0


def help_at(text: str, line: int) -> dict[str, Any]:
    """The key on a line of a YAML text, and the keys that may stand in its section.

    Returns:
        ``section``: its key path, empty for the job itself; ``key``: help for the key itself, or None; ``keys``: help for those
        of the section. Help is ``name``, ``about``, ``present``: whether the text has it.
    """
    document, path = _place(text, line)
    about = _about(path, document)
    section = next(path[:end] for end in range(len(path), -1, -1) if _keys(_about(path[:end], document)))
    written = _value(document, section)
    keys = [
        {"name": name, "about": in_one_line(each), "present": isinstance(written, Mapping) and name in written}
        for name, each in _keys(_about(section, document)).items()
    ]
    key = {"name": ".".join(map(str, path)), "about": in_one_line(about), "present": True} if path and about else None
    return {"section": ".".join(map(str, section)), "key": key, "keys": keys}


def _place(text: str, line: int) -> tuple[Any, tuple[str | int, ...]]:
    """The document, and the key path of a line; of the part above where the whole is not YAML."""
    for part in (text, "\n".join(text.splitlines()[: max(0, line - 1)])):
        try:
            document, lines = strict_yaml.load(part)
        except strict_yaml.YamlError:
            continue
        above = [(at, path) for path, at in lines.items() if at <= line]
        return document, max(above, default=(0, ()), key=lambda each: each[0])[1]
    return None, ()


def _about(path: tuple[str | int, ...], document: Any) -> Mapping[str, Any] | None:
    about: Mapping[str, Any] = job_schema()
    for i, key in enumerate(path):
        if path[: i + 1] == ("train", "config"):
            task = _value(document, ("train", "task"))
            found = config_schema(task) if isinstance(task, str) else None
            about = found or plain(about).get("properties", {}).get("config", {})
        elif isinstance(key, int):
            about = plain(about).get("items") or {}
        else:
            about = _keys(plain(about)).get(key) or {}
        if not about:
            return None
    return plain(about)


def _keys(about: Mapping[str, Any] | None) -> Mapping[str, Any]:
    """The keys of a section, also of one in whose place something else may stand."""
    for each in (about or {}, *(about or {}).get("anyOf", ())):
        if found := plain(each).get("properties"):
            keys: Mapping[str, Any] = found
            return keys
    return {}


def _value(document: Any, path: tuple[str | int, ...]) -> Any:
    for key in path:
        if isinstance(document, Mapping):
            document = document.get(key)
        elif isinstance(document, list) and isinstance(key, int) and key < len(document):
            document = document[key]
        else:
            return None
    return document


def in_one_line(about: Mapping[str, Any] | None) -> str:
    """A part of the schema in one line."""
    about = plain(about or {})
    choice = ", ".join(map(str, about.get("enum") or about.get("examples") or ()))
    default = about.get("default")
    parts = (
        re.sub(r":\w+:|`", "", str(about.get("description") or "").partition("\n")[0]).rstrip("."),
        f"one of {choice}" if choice else bounds(about),
        "" if default is None or isinstance(default, dict | list) else f"by default {default}",
    )
    return "; ".join(filter(None, parts))
