"""Fields of a task's configuration that may name a file: its content becomes part of the job when it is submitted.

A run then holds all that it was made from, and nothing needs the submitter's directory again. A dataclass marks such a field with
``field(metadata=kept_file(...))``; the command that submits a job reads the file, checks it, and puts its content in the place of the path.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

_KEY = "muster.file"


@dataclass(frozen=True)
class KeptFile:
    """How the content of a file stands in a configuration.

    Attributes:
        form: ``text``: a mapping of ``file``, its name, and ``text``; ``json``: the value that it holds.
        check: A module; ``python -m MODULE FILE`` ends with 0 where the file is valid, else with a last line that says what is wrong.
            Empty: what the configuration's class checks is enough.
        needs: Packages without which the check would say too much: where one is missing beside the command, the node checks.
    """

    form: Literal["text", "json"]
    check: str = ""
    needs: tuple[str, ...] = ()


def kept_file(form: Literal["text", "json"], check: str = "", needs: tuple[str, ...] = ()) -> Mapping[str, Any]:
    """The metadata of such a field; of the arguments see :class:`KeptFile`."""
    return {_KEY: KeptFile(form, check, needs)}


def kept_files(kind: Any) -> dict[str, KeptFile]:
    """Such fields of a configuration's class, by name; none of what is no dataclass."""
    if not dataclasses.is_dataclass(kind):
        return {}
    return {item.name: item.metadata[_KEY] for item in dataclasses.fields(kind) if _KEY in item.metadata}
