"""Files that a job's YAML names in its task's configuration: their content becomes part of the job when it is submitted."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from orchestrator.domain.errors import SpecError
from orchestrator.spec.changes import override
from orchestrator.spec.settings import task_config
from orchestrator.spec.values import place_of
from shared_store.file_fields import KeptFile, kept_files
from shared_store.settings import setting_at

MOST = 20 << 10
"""Bytes that a file may take in a job's definition, which has at most 24 KiB on AWS Batch, and so here."""
_SECTIONS = ("train", "evaluate", "race")


def with_files(
    document: Mapping[str, Any],
    source: str,
    lines: Mapping[tuple[str | int, ...], int] | None = None,
    *,
    task: str | None = None,
) -> dict[str, Any]:
    """A job's document with the content of the files that its task's configuration names in the place of their paths.

    Paths are relative to the working directory. Of a task that is not installed here nothing is known: its nodes read the path.

    Args:
        document: What the YAML holds.
        source: What to call it in an error.
        lines: Line of each key path in the file, for errors.
        task: Name of the task, where the document does not say it.

    Raises:
        SpecError: A file can't be read, is too large, or its check refuses it; one line with file, line and key.
    """
    result = dict(document)
    for section in _SECTIONS:
        values = result.get(section)
        config = values.get("config") if isinstance(values, Mapping) else None
        if not isinstance(values, Mapping) or not isinstance(config, Mapping):
            continue
        name = values.get("task", task)
        kind = task_config(name) if isinstance(name, str) else None
        kept = {}
        for field, how in kept_files(kind).items():
            if isinstance(path := config.get(field), str):
                try:
                    kept[field] = _content(path, how)
                except SpecError as error:
                    raise SpecError(f"{place_of((section, 'config', field), source, lines)}{error}") from None
        if kept:
            result[section] = {**values, "config": {**config, **kept}}
    return result


def changes_with_files(spec_of_run: Callable[[], Mapping[str, Any] | None], changes: Sequence[str] | None) -> list[str]:
    """``--set`` assignments for a run that is resumed or cloned, with the content of files as :func:`with_files`.

    ``spec_of_run`` is called where its task has to be known.

    Raises:
        SpecError: As :func:`with_files`.
    """
    given = list(changes or ())
    if not any(each.startswith(("train.config", "train=")) for each in given):
        return given
    trained = (spec_of_run() or {}).get("train") or {}
    task = setting_at(override({"train": {"task": trained.get("task")}}, given), "train.task")
    return [_embedded(each, task) for each in given]


def _embedded(assignment: str, task: Any) -> str:
    key = assignment.partition("=")[0]
    change = override({}, [assignment])
    whole = with_files(change, "", {tuple(key.split(".")): 0}, task=task)
    if whole == change:
        return assignment
    # as YAML reads it: what JSON writes in two halves beyond 16 bits is one character there
    text = re.sub(
        r"\\u(d[89ab]..)\\u(d[c-f]..)",
        lambda pair: f"\\U{0x10000 + ((int(pair[1], 16) & 0x3FF) << 10) + (int(pair[2], 16) & 0x3FF):08x}",
        json.dumps(setting_at(whole, key)),
    )
    return f"{key}={text}"


def _content(path: str, how: KeptFile) -> Any:
    """The value in the configuration. Raises SpecError."""
    try:
        with Path(path).open("rb") as stream:
            data = stream.read((1 << 20) + 1)
        text = data.decode("utf-8-sig")
    except (OSError, ValueError) as error:
        why = error.strerror if isinstance(error, OSError) else "it is not a text file (UTF-8)"
        raise SpecError(f"{path}: {why}; a path is relative to the directory of the command, {Path.cwd()}") from None
    value: Any = {"file": path, "text": text}
    if how.form == "json":
        try:
            value = json.loads(text)
        except (ValueError, RecursionError) as error:
            where = f":{error.lineno}" if isinstance(error, json.JSONDecodeError) else ""
            raise SpecError(f"{path}{where}: it is not JSON ({getattr(error, 'msg', 'nested too deeply')})") from None
        if isinstance(value, str):
            raise SpecError(f"{path}: it holds a text alone")
    # the job's spec is JSON in a text of JSON
    if (size := len(json.dumps(json.dumps(value)))) > MOST:
        raise SpecError(f"{path}: it takes {size:,} bytes of the job's definition, and may take {MOST:,}; shorten it")
    _check(path, how)
    return value


def _check(path: str, how: KeptFile) -> None:
    """Have another process check the file: what tasks are made of is the worker's. Raises SpecError."""
    if not how.check or any(find_spec(each) is None for each in how.needs):
        return
    command = [sys.executable, "-P", "-m", how.check, path]
    checked = subprocess.run(command, capture_output=True, text=True, check=False)
    if checked.returncode:
        said = checked.stderr.strip().splitlines() or [f"{how.check} ended with exit code {checked.returncode}"]
        raise SpecError(said[-1])
