"""Writing files so that a reader, after any crash, sees the old content or the new one and nothing between.

The rules are those that also hold on NFS and EFS: new content goes under a hidden name in the same directory, is fsynced and
closed (the close is where NFS reports a full disk), is renamed, and the directory is fsynced.
"""

from __future__ import annotations

import json
import os
import shutil
import uuid
from collections.abc import Mapping
from pathlib import Path
from typing import Any


def sync_file(path: Path) -> None:
    """Make the content of ``path`` durable. Raises OSError (ENOSPC, EIO) where the volume could not keep it."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def sync_directory(path: Path) -> None:
    """Make the names in directory ``path`` durable."""
    descriptor = os.open(path, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def write_atomic(path: Path, data: bytes) -> None:
    """Replace ``path`` with ``data``, whole or not at all. Raises OSError; a failed write leaves no file behind."""
    path.parent.mkdir(parents=True, exist_ok=True)
    hidden = path.parent / f".{path.name}.{uuid.uuid4().hex[:8]}.tmp"
    try:
        with open(hidden, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(hidden, path)
    except OSError:
        hidden.unlink(missing_ok=True)
        raise
    sync_directory(path.parent)


def write_json(path: Path, value: Mapping[str, Any]) -> None:
    """:func:`write_atomic` for a JSON document."""
    write_atomic(path, (json.dumps(value, indent=1, sort_keys=True) + "\n").encode())


def read_json(path: Path) -> dict[str, Any] | None:
    """The JSON object in ``path``; None where the file is not there. Raises ValueError where it is not a JSON object."""
    try:
        value = json.loads(path.read_bytes())
    except FileNotFoundError:
        return None
    if not isinstance(value, dict):
        raise ValueError(f"{path}: not a JSON object")
    return value


def remove_tree(path: Path) -> None:
    """Delete a directory so that no reader sees half of it: hide it by a rename first, then delete."""
    hidden = path.parent / f".{path.name.lstrip('.')}.{uuid.uuid4().hex[:8]}.trash"
    os.rename(path, hidden)
    shutil.rmtree(hidden, ignore_errors=True)
