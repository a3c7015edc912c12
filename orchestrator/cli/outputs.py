"""Outputs: the files that commands write."""

from __future__ import annotations

import os
from pathlib import Path

from orchestrator.domain.errors import UsageError


def check_output(path: Path, overwrite: bool, *endings: str) -> None:
    """Refuse an output that can't be written before anything runs. Raises UsageError."""
    if path.is_dir():
        raise UsageError(f"-o {path}: it is a directory; name a file in it, such as {path / ('policy' + endings[0])}")
    if path.suffix not in endings:
        raise UsageError(f"-o {path}: unknown ending; use one of {', '.join(endings)}")
    above = path.absolute().parent
    if not above.is_dir():
        raise UsageError(f"-o {path}: {above} is not a directory; create it first")
    if not os.access(above, os.W_OK):
        raise UsageError(f"-o {path}: {above} can't be written to; choose another directory")
    if path.exists() and not overwrite:
        raise UsageError(f"-o {path}: it exists; --overwrite replaces it")
    cut = path.with_name(f"{path.name}.partial")
    if path.suffix == ".mcap" and cut.exists() and not overwrite:
        raise UsageError(
            f"-o {path}: {cut.name} exists, a recording that was cut short, or one that is being made; muster record --recover {cut} "
            "saves it, --overwrite replaces it"
        )
