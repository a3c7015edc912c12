"""Long texts of jobs, such as reward functions, each a file named by its SHA-256.

A text that is too long for a job's definition lies in ``texts/<controller>/`` of the store from its upload on. When an attempt begins,
the controller copies it into ``texts/`` of the job's run, where every rank reads it: the run explains itself later. In a definition
``{file, sha256}`` stands in the place of ``{file, text}``.
"""

from __future__ import annotations

import errno
import hashlib
import json
import re
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from shared_store.contract.plugins import evaluating
from shared_store.volume.files import DamagedFile, open_regular, write_atomic

LARGEST = 1 << 20
"""Bytes of a text (UTF-8)."""
IN_DEFINITION = 20 << 10
"""Bytes that a spec may take in a job's definition, which has at most 24 KiB on AWS Batch, and so here."""
_OF_REFERENCE = 256
"""Bytes of a text that takes no more room in a definition than its digest."""
_DIGEST = re.compile(r"[0-9a-f]{64}")
_HALF = re.compile("[\ud800-\udfff]")
"""A half of a character, which JSON can name and no file can hold."""


class TextError(ValueError):
    """A kept text is missing or altered; one line with its file, its place and the remedy."""


@dataclass(frozen=True)
class Reference:
    """A text that a job's spec names by its digest."""

    key: str
    """Of the spec, such as ``train.config.reward_function``."""
    file: str
    """The name that the submitter's file had."""
    sha256: str

    def __str__(self) -> str:
        return f"{self.key}: {self.file[:200]} (sha256 {self.sha256})"


def digest_of(text: str) -> str:
    """SHA-256 of a text in UTF-8, in hexadecimal."""
    return hashlib.sha256(text.encode()).hexdigest()


def size_in_definition(value: Any) -> int:
    """Bytes that a value takes in a definition, whose spec is JSON in a text of JSON."""
    return len(json.dumps(json.dumps(value)))


def references(spec: Mapping[str, Any] | None) -> list[Reference]:
    """The texts that a job's spec names by their digests."""
    return [_reference(*entry) for entry in _entries(spec) if is_reference(entry[2])]


def beside(spec: Mapping[str, Any]) -> tuple[dict[str, Any], dict[Reference, str]]:
    """A job's spec with references in the place of its long texts, and those texts: the longest first, until it fits into a definition."""
    result, texts = dict(spec), dict[Reference, str]()
    found = [
        (size_in_definition(value), section, field, value)
        for section, field, value in _entries(spec)
        if isinstance(value, Mapping) and value.keys() <= {"file", "text"} and isinstance(value.get("text"), str)
    ]
    for size, section, field, value in sorted(found, key=lambda each: each[0], reverse=True):
        if size <= _OF_REFERENCE or _HALF.search(value["text"]):
            continue
        again = {
            key: spec[key] for key in ("environment", "secrets", "command") if key in spec
        }  # as the definition has them
        if size_in_definition(result) + len(json.dumps(again)) <= IN_DEFINITION:
            break
        kept = {"file": str(value.get("file") or field), "sha256": digest_of(value["text"])}
        result[section] = {**result[section], "config": {**result[section]["config"], field: kept}}
        texts[_reference(section, field, kept)] = value["text"]
    return result, texts


def resolved(config: Mapping[str, Any], directory: Path, where: str) -> dict[str, Any]:
    """A task's configuration with the texts in the place of their references.

    Args:
        config: The configuration.
        directory: That of the texts.
        where: Key of the configuration in the spec, for errors.

    Raises:
        TextError: A text is missing or altered.
        OSError: The volume can't be read.
    """
    return {field: _resolved(value, directory, f"{where}.{field}") for field, value in config.items()}


def _resolved(value: Any, directory: Path, key: str) -> Any:
    if not is_reference(value):
        return value
    name = value.get("file", key.rpartition(".")[2])
    return {"file": name, "text": read(directory, Reference(key, name, value["sha256"]))}


def resolved_spec(spec: Mapping[str, Any], *directories: Path) -> dict[str, Any]:
    """A job's spec with the texts in the place of their references, to be shown: a text that none of the directories has is left out."""
    result = dict(spec)
    for section, field, value in _entries(spec):
        for directory in directories:
            with suppress(TextError, OSError):
                value = _resolved(value, directory, f"{section}.config.{field}")
        result[section] = {**result[section], "config": {**result[section]["config"], field: value}}
    return result


def keep(directory: Path, data: bytes) -> str:
    """Keep a text under its digest, which is returned; one that is there already is written again. Raises OSError, such as for a full volume."""
    digest = hashlib.sha256(data).hexdigest()
    write_atomic(directory / digest, data, levels=2)
    return digest


def read(directory: Path, reference: Reference) -> str:
    """A kept text, whose digest is checked. Raises TextError, OSError."""
    path = directory / reference.sha256
    try:
        with open_regular(path) as file:
            data = file.read(LARGEST + 1)
    except DamagedFile as error:
        raise _lost(reference, path, str(error).partition(": ")[2]) from None
    except OSError as error:
        if error.errno not in (errno.ENOENT, errno.ENOTDIR):
            raise
        raise _lost(reference, path, "missing") from None
    if hashlib.sha256(data).hexdigest() != reference.sha256:
        raise _lost(reference, path, "altered: its content has another digest")
    return data.decode()


def read_either(first: Path, second: Path, reference: Reference) -> str:
    """:func:`read` from the first of two directories that has the text unaltered."""
    try:
        return read(first, reference)
    except TextError:
        return read(second, reference)


def _lost(reference: Reference, path: Path, why: str) -> TextError:
    return TextError(f"{reference}: the text kept at {path} is {why}; submit the job again with the file")


def _entries(spec: Mapping[str, Any] | None) -> Iterator[tuple[str, str, Any]]:
    """Section, field and value of all entries of the tasks' configurations in a spec."""
    for section in ("train", *evaluating()):
        values = (spec or {}).get(section)
        config = values.get("config") if isinstance(values, Mapping) else None
        yield from ((section, field, value) for field, value in (config.items() if isinstance(config, Mapping) else ()))


def _reference(section: str, field: str, value: Mapping[str, Any]) -> Reference:
    return Reference(f"{section}.config.{field}", value.get("file", field), value["sha256"])


def is_file(value: Any) -> bool:
    """Whether a value of a configuration is the content of a file: its text, or the digest of that."""
    return is_reference(value) or (isinstance(value, Mapping) and value.keys() == {"file", "text"})


def is_reference(value: Any) -> bool:
    """Whether a value of a configuration stands for a text by its digest; the name of the file may be missing, and the text empty."""
    return (
        isinstance(value, Mapping)
        and {"sha256"} <= value.keys() <= {"file", "sha256", "text"}
        and value.get("text", "") == ""
        and isinstance(value.get("file", ""), str)
        and isinstance(value["sha256"], str)
        and _DIGEST.fullmatch(value["sha256"]) is not None
    )
