"""Files that a job's YAML names in its task's configuration: their content becomes part of the job when it is submitted.

A text that is too long for the job's definition is kept beside it (:mod:`shared_store.volume.texts`).
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from orchestrator.domain.errors import SpecError
from orchestrator.spec.changes import override
from orchestrator.spec.settings import task_config
from orchestrator.spec.values import place_of
from shared_store.contract import plugins
from shared_store.contract.file_fields import KeptFile, kept_files
from shared_store.volume.run_settings import setting_at
from shared_store.volume.texts import IN_DEFINITION, LARGEST, beside, is_reference, size_in_definition

Note = Callable[[str], object]
"""Is called with a line for the user."""
TextOf = Callable[[str], str | None]
"""The long text of a run by its SHA-256; None: it is not there."""
Place = Callable[[], str | None]
"""The path of the store in which a job finds what its configuration names, asked where a check needs it; None: not on this machine."""


def with_files(
    document: Mapping[str, Any],
    source: str,
    lines: Mapping[tuple[str | int, ...], int] | None = None,
    *,
    task: str | None = None,
    base: Mapping[str, Any] | None = None,
    store: Place = lambda: None,
    note: Note | None = None,
    text_of: TextOf = lambda _: None,
) -> dict[str, Any]:
    """A job's document with the content of the files that its task's configuration names in the place of their paths.

    Paths are relative to the working directory. Of a task that is not installed here nothing is known: its nodes read the path.

    Args:
        document: The content of the YAML.
        source: Its name in errors.
        lines: Line of each key path in the file, for errors.
        task: Name of the task, where the document does not say it.
        base: The configuration that the document's changes. A file's content in it is checked anew where the document changes what the
            check depends on.
        store: Where checks find what the configuration names.
        note: Called with each line that a check has for the user.
        text_of: Is called with the digest of a long text in ``base`` that is checked anew.

    Raises:
        SpecError: A file can't be read, is too large, or its check refuses it; one line with file, line and key.
    """
    result = dict(document)
    for section, field, value, how in _fields(document, task):
        if isinstance(value, str):
            try:
                content = _content(value, how, _Checked(how, _whole(section, document[section], base), store, note))
            except SpecError as error:
                raise SpecError(f"{place_of((section, 'config', field), source, lines)}{error}") from None
            values = result[section]
            result[section] = {**values, "config": {**values["config"], field: content}}
    _check_again(document, source, lines or {}, task, base or {}, store, note, text_of)
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
    store: Place = lambda: None,
    note: Note | None = None,
) -> None:
    """Check the texts that stand in the place of files, as :func:`with_files` checks files. Arguments and errors as there."""
    for section, field, value, how in _fields(document):
        try:
            _check_text(value, field, _Checked(how, _whole(section, document[section], None), store, note))
        except SpecError as error:
            raise SpecError(f"{place_of((section, 'config', field), source, lines)}{error}") from None


def _check_again(
    document: Mapping[str, Any],
    source: str,
    lines: Mapping[tuple[str | int, ...], int],
    task: str | None,
    base: Mapping[str, Any],
    store: Place,
    note: Note | None,
    text_of: TextOf,
) -> None:
    """Check the texts of ``base`` where a section changes what their check depends on. Raises SpecError."""
    for section in ("train", *plugins.evaluating()):
        values = document.get(section)
        if not isinstance(values, Mapping):
            continue
        config, name = values.get("config") or {}, values.get("task", task)
        if not isinstance(config, Mapping):
            continue
        whole = _whole(section, values, base)
        for field, how in kept_files(task_config(name) if isinstance(name, str) else None).items():
            changed = [key for key in how.given if whole.get(key) != base.get(key)]
            if field in config or not changed:
                continue
            try:
                _check_text(_with_text(base.get(field), field, text_of, note), field, _Checked(how, whole, store, note))
            except SpecError as error:
                raise SpecError(f"{place_of((section, 'config', changed[0]), source, lines)}{error}") from None


def _with_text(value: Any, field: str, text_of: TextOf, note: Note | None) -> Any:
    """A field with its text in the place of its digest, where that is to be had."""
    if not is_reference(value):
        return value
    name = value.get("file", field)
    if (text := text_of(value["sha256"])) is not None:
        return {"file": name, "text": text}
    if note is not None:
        note(f"{name}: its text is not in the run: it is not tried here, but on the job's nodes")
    return value


def _whole(section: str, values: Mapping[str, Any], base: Mapping[str, Any] | None) -> Mapping[str, Any]:
    """The configuration of a section, as far as it is known."""
    rules = plugins.rules_of(section)
    changes = rules.changes(values) if rules else values.get("config") or {}
    return {**(base or {}), **changes}


def _check_text(value: Any, field: str, checked: _Checked) -> None:
    """Raises SpecError."""
    text = value.get("text") if isinstance(value, Mapping) else None
    if checked.how.form == "text" and isinstance(text, str):
        with TemporaryDirectory() as folder:
            path = Path(folder) / "text"
            path.write_text(text, encoding="utf-8")
            _check(str(path), checked, str(value.get("file") or field))


def _fields(document: Mapping[str, Any], task: str | None = None) -> Iterator[tuple[str, str, Any, KeptFile]]:
    """Section, name and value of the given fields that may name a file; of a task that is installed."""
    for section in ("train", *plugins.evaluating()):
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
    store: Place = lambda: None,
    note: Note | None = None,
    text_of: TextOf = lambda _: None,
) -> list[str]:
    """``--set`` assignments for a run that is resumed or cloned, with the content of files as :func:`with_files`.

    ``spec_of_run`` is called where its task has to be known, ``keep`` with each long text, whose digest the assignment has. ``store``,
    ``note`` and ``text_of`` as of :func:`with_files`.

    Raises:
        SpecError: As :func:`with_files`.
    """
    given = list(changes or ())
    if not any(each.startswith(("train.config", "train=")) for each in given):
        return given
    trained = (spec_of_run() or {}).get("train") or {}
    before = trained.get("config") or {}
    changed = override({"train": {"task": trained.get("task"), "config": before}}, given)
    task, config = (setting_at(changed, key) for key in ("train.task", "train.config"))
    if isinstance(config, Mapping) and isinstance(task, str):
        new = {field: value for field, value in config.items() if value != before.get(field)}
        _check_again({"train": {"config": new}}, "--set", {}, task, before, store, note, text_of)
    return [_embedded(each, task, config, keep, store, note) for each in given]


def _embedded(
    assignment: str, task: Any, config: Any, keep: Callable[[str], object], store: Place, note: Note | None
) -> str:
    key = assignment.partition("=")[0]
    change = override({}, [assignment])
    base = config if isinstance(config, Mapping) else {}
    whole, texts = beside(
        with_files(change, "", {tuple(key.split(".")): 0}, task=task, base=base, store=store, note=note)
    )
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


@dataclass(frozen=True)
class _Checked:
    """How a file is checked, with the configuration in which it stands; the other attributes as of :func:`with_files`."""

    how: KeptFile
    config: Mapping[str, Any]
    store: Place
    note: Note | None


def _content(path: str, how: KeptFile, checked: _Checked) -> Any:
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
    _check(path, checked)
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


def _check(path: str, checked: _Checked, name: str = "") -> None:
    """Have another process check the file, since the parts of tasks belong to the worker. Raises SpecError, in which ``name`` stands for the path."""
    how, note = checked.how, checked.note
    if not how.check or any(find_spec(each) is None for each in how.needs):
        return
    command = [sys.executable, "-P", "-m", how.check, path]
    if how.given:
        given = {field: checked.config[field] for field in how.given if field in checked.config}
        command += ["--config", json.dumps(given)]
        command += ["--store", store] if (store := checked.store()) is not None else []
    answer = subprocess.run(command, capture_output=True, text=True, check=False)
    said = [line.replace(path, name or path, 1) for line in answer.stderr.strip().splitlines()]
    if answer.returncode:
        raise SpecError(said[-1] if said else f"{how.check} ended with exit code {answer.returncode}")
    if note is not None:
        for line in said:
            note(line)
