"""Fields of a task's configuration that may name a file: its content becomes part of the job when it is submitted.

A run then holds all of its inputs, and nothing needs the submitter's directory again. A dataclass marks such a field with
``field(metadata=kept_file(...))``; the submitting command reads and checks the file, and replaces the path by its content.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

_KEY = "muster.file"


@dataclass(frozen=True)
class KeptFile:
    """Form of a file's content in a configuration.

    Attributes:
        form: ``text``: a mapping of ``file``, its name, and ``text``, or of ``file`` and ``sha256`` for a long text, which is kept
            beside the job (:mod:`shared_store.volume.texts`), and which the ranks get as ``text``; ``json``: the value in the file.
        check: A module; ``python -m MODULE FILE`` exits with 0 for a valid file, and its standard error has notes for the user;
            otherwise its last line names the error.
            Empty: the configuration's class checks enough.
        check_reads: Other fields of the configuration that the check depends on; it gets them as JSON after ``--config``, and the store's path
            after ``--store``.
        needs: Packages without which the check would refuse valid files: if the command lacks one, the node checks.
    """

    form: Literal["text", "json"]
    check: str = ""
    needs: tuple[str, ...] = ()
    check_reads: tuple[str, ...] = ()


def kept_file(
    form: Literal["text", "json"], check: str = "", needs: tuple[str, ...] = (), check_reads: tuple[str, ...] = ()
) -> Mapping[str, Any]:
    """The metadata of such a field; for the arguments see :class:`KeptFile`."""
    return {_KEY: KeptFile(form, check, needs, check_reads)}


def kept_files(kind: Any) -> dict[str, KeptFile]:
    """Such fields of a configuration's class, by name; none if it is not a dataclass."""
    if not dataclasses.is_dataclass(kind):
        return {}
    return {item.name: item.metadata[_KEY] for item in dataclasses.fields(kind) if _KEY in item.metadata}
