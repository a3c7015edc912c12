"""Reading a spec from a YAML file, remembering on which line each key stands."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from orchestrator.domain.errors import SpecError
from orchestrator.spec import strict_yaml
from orchestrator.spec.changes import override
from orchestrator.spec.kept_files import Place, check_texts, refuse_paths, with_files
from orchestrator.spec.model import Spec, validate
from shared_store.volume.files import DamagedFile, read_json


def load(path: str, assignments: list[str] | None = None, store: Place = lambda: None) -> Spec:
    """The spec in the file ``path`` with ``--set`` assignments applied, and the files that its task's configuration names read.

    ``store``: as of :func:`~orchestrator.spec.kept_files.with_files`.

    Raises:
        SpecError: A file can't be read, is not YAML, or is not a valid spec; one line with file, line and key.
    """
    document, lines = read(path)
    if assignments and isinstance(document, dict):
        document = override(document, assignments)
        changed = [tuple(assignment.partition("=")[0].split(".")) for assignment in assignments]
        # what --set changed stands on no line of the file
        lines = {key: line for key, line in lines.items() if not any(key[: len(each)] == each for each in changed)}
        lines |= dict.fromkeys(changed, 0)
    notes: list[str] = []
    if isinstance(document, dict):
        document = with_files(document, path, lines, store=store, note=notes.append)
    return validate(_with_hyperparameters(document, path, lines), path, lines).with_notes(notes)


def from_text(text: str, source: str, *, whole: bool = True, store: Place = lambda: None) -> Spec:
    """The spec in a YAML text that a request brought: without aliases, and without paths of files that belong into the job.

    Args:
        text: The YAML.
        source: Its name in errors.
        whole: Also have a process try the texts that stand in the place of files, which takes a second or more.
        store: As of :func:`~orchestrator.spec.kept_files.with_files`.

    Raises:
        SpecError: As :func:`load`.
    """
    document, lines = _parsed(text, source, aliases=False)
    spec, notes = from_document(document, source, lines), list[str]()
    if whole:
        check_texts(document, source, lines, store, notes.append)
    return spec.with_notes(notes)


def from_document(document: Any, source: str, lines: Mapping[strict_yaml.Path, int] | None = None) -> Spec:
    """The spec in a document that a request brought: without paths of files that belong into the job.

    Args:
        document: What the YAML says.
        source: Its name in errors.
        lines: The line of each key; empty for a document that has none.

    Raises:
        SpecError: It is not a valid spec; one line with the key.
    """
    if isinstance(document, dict):
        refuse_paths(document, source, lines or {})
    return validate(document, source, lines or {})


def _with_hyperparameters(document: Any, path: str, lines: Mapping[strict_yaml.Path, int]) -> Any:
    """The document with the content of the JSON file that ``train.hyperparameters`` names. Raises SpecError."""
    train = document.get("train") if isinstance(document, dict) else None
    named = train.get("hyperparameters") if isinstance(train, dict) else None
    if not isinstance(train, dict) or not isinstance(named, str):
        return document
    key = ("train", "hyperparameters")
    where = f"{path}:{lines[key]}" if lines.get(key) else "--set"
    try:
        content = read_json(Path(named), strict_yaml.MOST_CHARACTERS)
    except DamagedFile as error:
        raise SpecError(f"{where}: {'.'.join(key)}: {error}") from None
    except OSError as error:
        raise SpecError(f"{where}: {'.'.join(key)}: {named}: {error.strerror}") from None
    if content is None:
        raise SpecError(f"{where}: {'.'.join(key)}: {named}: there is no such file in {Path.cwd()}")
    return {**document, "train": {**train, "hyperparameters": content}}


def read(path: str) -> tuple[Any, Mapping[strict_yaml.Path, int]]:
    """The document of a YAML file, and the line of each key path. Raises SpecError."""
    try:
        text = Path(path).read_text(encoding="utf-8")
    except OSError as error:
        raise SpecError(f"{path}: {error.strerror}") from None
    except UnicodeDecodeError:
        raise SpecError(f"{path}: not a text file (UTF-8)") from None
    return _parsed(text, path, aliases=True)


def _parsed(text: str, source: str, *, aliases: bool) -> tuple[Any, Mapping[strict_yaml.Path, int]]:
    """The document, and the line of each key path. Raises SpecError."""
    try:
        return strict_yaml.load(text, aliases=aliases)
    except strict_yaml.YamlError as error:
        key = f"{error.key}: " if error.key else "not valid YAML: "
        where = f"{source}:{error.line}" if error.line else source
        raise SpecError(f"{where}: {key}{error}") from None
