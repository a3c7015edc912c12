"""Files that a job's YAML names in its task's configuration: their content becomes part of the job when it is submitted.

A text that is too long for the job's definition is kept beside it (:mod:`shared_store.volume.texts`).
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
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
Lines = Mapping[tuple[str | int, ...], int]


@dataclass(frozen=True)
class _Origin:
    """Where a document comes from, and what the checks of its files need; attributes as the arguments of :func:`with_files`."""

    source: str
    lines: Lines | None = None
    task: str | None = None
    base: Mapping[str, Any] = field(default_factory=dict)
    store: Place = lambda: None
    note: Note | None = None
    text_of: TextOf = lambda _: None

    def fields(self, document: Mapping[str, Any]) -> Iterator[tuple[str, Mapping[str, Any], str, KeptFile]]:
        """Section, configuration, name and form of each field that may name a file, given or not; of tasks that are installed."""
        for section in ("train", *plugins.evaluating()):
            values = document.get(section)
            config = (values.get("config") or {}) if isinstance(values, Mapping) else None
            if not isinstance(values, Mapping) or not isinstance(config, Mapping):
                continue
            name = values.get("task", self.task)
            for each, how in kept_files(task_config(name) if isinstance(name, str) else None).items():
                yield section, config, each, how

    def present_fields(self, document: Mapping[str, Any]) -> Iterator[tuple[str, str, Any, KeptFile]]:
        """Section, name, value and form of the fields that the document gives."""
        return (
            (section, name, config[name], how) for section, config, name, how in self.fields(document) if name in config
        )

    @contextmanager
    def at(self, section: str, name: str) -> Iterator[None]:
        """A block whose SpecError gets file, line and key of a field."""
        try:
            yield
        except SpecError as error:
            raise SpecError(f"{place_of((section, 'config', name), self.source, self.lines)}{error}") from None

    def whole(self, section: str, values: Mapping[str, Any]) -> Mapping[str, Any]:
        """The configuration of a section, as far as it is known."""
        rules = plugins.rules_of(section)
        return {**self.base, **(rules.changes(values) if rules else values.get("config") or {})}

    def check(self, path: str, how: KeptFile, config: Mapping[str, Any], name: str = "") -> None:
        """Have another process check the file, since the parts of tasks belong to the worker.

        ``config``: in which the file stands. Raises SpecError, in which ``name`` stands for the path.
        """
        if not how.check or any(find_spec(each) is None for each in how.needs):
            return
        command = [sys.executable, "-P", "-m", how.check, path]
        if how.check_reads:
            command += ["--config", json.dumps({each: config[each] for each in how.check_reads if each in config})]
            command += ["--store", store] if (store := self.store()) is not None else []
        response = subprocess.run(command, capture_output=True, text=True, check=False)
        output = [line.replace(path, name or path, 1) for line in response.stderr.strip().splitlines()]
        if response.returncode:
            raise SpecError(output[-1] if output else f"{how.check} ended with exit code {response.returncode}")
        if self.note is not None:
            for line in output:
                self.note(line)

    def check_text(self, value: Any, name: str, how: KeptFile, config: Mapping[str, Any]) -> None:
        """Check a text that stands in the place of a file. Raises SpecError."""
        text = value.get("text") if isinstance(value, Mapping) else None
        if how.form == "text" and isinstance(text, str):
            with TemporaryDirectory() as folder:
                path = Path(folder) / "text"
                path.write_text(text, encoding="utf-8")
                self.check(str(path), how, config, str(value.get("file") or name))

    def check_again(self, document: Mapping[str, Any]) -> None:
        """Check the texts of ``base`` where a section changes what their check depends on. Raises SpecError."""
        for section, config, name, how in self.fields(document):
            whole = self.whole(section, document[section])
            changed = [key for key in how.check_reads if whole.get(key) != self.base.get(key)]
            if changed and name not in config:
                with self.at(section, changed[0]):
                    self.check_text(self.with_text(self.base.get(name), name), name, how, whole)

    def with_text(self, value: Any, name: str) -> Any:
        """A field with its text in the place of its digest, where that is to be had."""
        if not is_reference(value):
            return value
        name = value.get("file", name)
        if (text := self.text_of(value["sha256"])) is not None:
            return {"file": name, "text": text}
        if self.note is not None:
            self.note(f"{name}: its text is not in the run: it is not tried here, but on the job's nodes")
        return value


def with_files(
    document: Mapping[str, Any],
    source: str,
    lines: Lines | None = None,
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
    result, origin = dict(document), _Origin(source, lines, task, base or {}, store, note, text_of)
    for section, name, value, how in origin.present_fields(document):
        if isinstance(value, str):
            with origin.at(section, name):
                content = _content(value, how)
                origin.check(value, how, origin.whole(section, document[section]))
            values = result[section]
            result[section] = {**values, "config": {**values["config"], name: content}}
    origin.check_again(document)
    return result


def refuse_paths(document: Mapping[str, Any], source: str, lines: Lines) -> None:
    """Refuse paths in a document that a request brought, whose files are not on this machine, and contents that are too large.

    Arguments as :func:`with_files`.

    Raises:
        SpecError: A path stands where the content of its file belongs, or a content is too large; one line with key and line.
    """
    origin = _Origin(source, lines)
    for section, name, value, how in origin.present_fields(document):
        with origin.at(section, name):
            if isinstance(value, str):
                form = "{file: NAME, text: …}" if how.form == "text" else "the value in it"
                raise SpecError(
                    f"found a path; only `muster submit` and `muster run` read files, so write what the file holds: {form}"
                )
            _check_size(str(value.get("file") or name) if isinstance(value, Mapping) else name, value, how)


def check_texts(
    document: Mapping[str, Any], source: str, lines: Lines, store: Place = lambda: None, note: Note | None = None
) -> None:
    """Check the texts that stand in the place of files, as :func:`with_files` checks files. Arguments and errors as there."""
    origin = _Origin(source, lines, store=store, note=note)
    for section, name, value, how in origin.present_fields(document):
        with origin.at(section, name):
            origin.check_text(value, name, how, origin.whole(section, document[section]))


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
    assignments = list(changes or ())
    if not any(each.startswith(("train.config", "train=")) for each in assignments):
        return assignments
    trained = (spec_of_run() or {}).get("train") or {}
    before = trained.get("config") or {}
    changed = override({"train": {"task": trained.get("task"), "config": before}}, assignments)
    task, config = (setting_at(changed, key) for key in ("train.task", "train.config"))
    if isinstance(config, Mapping) and isinstance(task, str):
        new = {name: value for name, value in config.items() if value != before.get(name)}
        _Origin("--set", {}, task, before, store, note, text_of).check_again({"train": {"config": new}})
    return [_embedded(each, task, config, keep, store, note) for each in assignments]


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


def _content(path: str, how: KeptFile) -> Any:
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
            raise SpecError(f"{path}: expected a list or an object, found a string")
    _check_size(path, value, how)
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
