"""Files that a job's YAML names in its task's configuration: their content becomes part of the job when it is submitted.

A text that is too long for the job's definition is kept beside it (:mod:`shared_store.texts`).
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from orchestrator.domain.errors import SpecError
from orchestrator.spec.changes import override
from orchestrator.spec.settings import task_config
from orchestrator.spec.values import place_of
from shared_store.file_fields import KeptFile, kept_files
from shared_store.settings import setting_at
from shared_store.texts import IN_DEFINITION, LARGEST, beside, size_in_definition

_SECTIONS = ("train", "evaluate", "race")
Note = Callable[[str], object]
"""Is called with a line for the user."""


def with_files(
    document: Mapping[str, Any],
    source: str,
    lines: Mapping[tuple[str | int, ...], int] | None = None,
    *,
    task: str | None = None,
    note: Note | None = None,
) -> dict[str, Any]:
    """A job's document with the content of the files that its task's configuration names in the place of their paths.

    Paths are relative to the working directory. Of a task that is not installed here nothing is known: its nodes read the path.

    Args:
        document: The content of the YAML.
        source: Its name in errors.
        lines: Line of each key path in the file, for errors.
        task: Name of the task, where the document does not say it.
        note: Called with each line that a check has for the user.

    Raises:
        SpecError: A file can't be read, is too large, or its check refuses it; one line with file, line and key.
    """
    result = dict(document)
    for section, field, value, how in _fields(document, task):
        if isinstance(value, str):
            try:
                content = _content(value, how, note)
            except SpecError as error:
                raise SpecError(f"{place_of((section, 'config', field), source, lines)}{error}") from None
            values = result[section]
            result[section] = {**values, "config": {**values["config"], field: content}}
    return result


def refuse_paths(document: Mapping[str, Any], source: str, lines: Mapping[tuple[str | int, ...], int]) -> None:
    """Refuse paths in a document that a request brought: the files are not on this machine. Arguments as :func:`with_files`.

    Raises:
        SpecError: A path stands where the content of its file belongs; one line with key and line.
    """
    for section, field, value, how in _fields(document):
        if isinstance(value, str):
            form = "{file: NAME, text: …}" if how.form == "text" else "the value in it"
            raise SpecError(
                f"{place_of((section, 'config', field), source, lines)}found a path; only `muster submit` and `muster run` read "
                f"files, so write what the file holds: {form}"
            )


def check_sizes(document: Mapping[str, Any], source: str, lines: Mapping[tuple[str | int, ...], int]) -> None:
    """Refuse a file's content that is too large, before anything else is done with it. Arguments as :func:`with_files`. Raises SpecError."""
    for section, field, value, how in _fields(document):
        try:
            _check_size(str(value.get("file") or field) if isinstance(value, Mapping) else field, value, how)
        except SpecError as error:
            raise SpecError(f"{place_of((section, 'config', field), source, lines)}{error}") from None


def check_texts(
    document: Mapping[str, Any],
    source: str,
    lines: Mapping[tuple[str | int, ...], int],
    note: Note | None = None,
) -> None:
    """Check the texts that stand in the place of files, as :func:`with_files` checks files. Arguments and errors as there."""
    for section, field, value, how in _fields(document):
        text = value.get("text") if isinstance(value, Mapping) else None
        if how.form != "text" or not isinstance(text, str):
            continue
        name = str(value.get("file") or field)
        try:
            with TemporaryDirectory() as folder:
                path = Path(folder) / "text"
                path.write_text(text, encoding="utf-8")
                _check(str(path), how, note, name)
        except SpecError as error:
            raise SpecError(f"{place_of((section, 'config', field), source, lines)}{error}") from None


def _fields(document: Mapping[str, Any], task: str | None = None) -> Iterator[tuple[str, str, Any, KeptFile]]:
    """Section, name and value of the given fields that may name a file; of a task that is installed."""
    for section in _SECTIONS:
        values = document.get(section)
        config = values.get("config") if isinstance(values, Mapping) else None
        if not isinstance(values, Mapping) or not isinstance(config, Mapping):
            continue
        name = values.get("task", task)
        kind = task_config(name) if isinstance(name, str) else None
        for field, how in kept_files(kind).items():
            if field in config:
                yield section, field, config[field], how


def changes_with_files(
    spec_of_run: Callable[[], Mapping[str, Any] | None],
    changes: Sequence[str] | None,
    keep: Callable[[str], object],
    note: Note | None = None,
) -> list[str]:
    """``--set`` assignments for a run that is resumed or cloned, with the content of files as :func:`with_files`.

    ``spec_of_run`` is called where its task has to be known, ``keep`` with each long text, whose digest the assignment has. ``note`` as of
    :func:`with_files`.

    Raises:
        SpecError: As :func:`with_files`.
    """
    given = list(changes or ())
    if not any(each.startswith(("train.config", "train=")) for each in given):
        return given
    trained = (spec_of_run() or {}).get("train") or {}
    task = setting_at(override({"train": {"task": trained.get("task")}}, given), "train.task")
    return [_embedded(each, task, keep, note) for each in given]


def _embedded(assignment: str, task: Any, keep: Callable[[str], object], note: Note | None) -> str:
    key = assignment.partition("=")[0]
    change = override({}, [assignment])
    whole, texts = beside(with_files(change, "", {tuple(key.split(".")): 0}, task=task, note=note))
    if whole == change:
        return assignment
    for text in texts.values():
        keep(text)
    # as YAML reads it: what JSON writes in two halves beyond 16 bits is one character there
    text = re.sub(
        r"\\u(d[89ab]..)\\u(d[c-f]..)",
        lambda pair: f"\\U{0x10000 + ((int(pair[1], 16) & 0x3FF) << 10) + (int(pair[2], 16) & 0x3FF):08x}",
        json.dumps(setting_at(whole, key)),
    )
    return f"{key}={text}"


def _content(path: str, how: KeptFile, note: Note | None) -> Any:
    """The value in the configuration. Raises SpecError."""
    try:
        with Path(path).open("rb") as stream:
            data = stream.read(LARGEST + 1)
        if len(data) > LARGEST:
            raise SpecError(f"{path}: it has more than {LARGEST:,} bytes; shorten it")
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
    _check_size(path, value, how)
    _check(path, how, note)
    return value


def _check_size(name: str, value: Any, how: KeptFile) -> None:
    """Raises SpecError."""
    text = value.get("text") if how.form == "text" and isinstance(value, Mapping) else None
    if isinstance(text, str):
        if len(text.encode(errors="replace")) > LARGEST:
            raise SpecError(f"{name}: it has more than {LARGEST:,} bytes; shorten it")
    elif (size := size_in_definition(value)) > IN_DEFINITION:
        words = f"it takes {size:,} bytes of the job's definition, and may take {IN_DEFINITION:,}"
        raise SpecError(f"{name}: {words}; shorten it")


def _check(path: str, how: KeptFile, note: Note | None, name: str = "") -> None:
    """Have another process check the file, since the parts of tasks belong to the worker. Raises SpecError, in which ``name`` stands for the path."""
    if not how.check or any(find_spec(each) is None for each in how.needs):
        return
    command = [sys.executable, "-P", "-m", how.check, path]
    checked = subprocess.run(command, capture_output=True, text=True, check=False)
    said = [line.replace(path, name or path, 1) for line in checked.stderr.strip().splitlines()]
    if checked.returncode:
        raise SpecError(said[-1] if said else f"{how.check} ended with exit code {checked.returncode}")
    if note is not None:
        for line in said:
            note(line)
