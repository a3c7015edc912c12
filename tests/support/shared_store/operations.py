"""What a program does to make its files durable."""

from __future__ import annotations

import os
from collections.abc import Callable

import pytest

StrPath = str | os.PathLike[str]


def durable_operations(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, str]]:
    """Every fsync and rename from now on, in order, as (operation, path); they are carried out as ever."""
    seen: list[tuple[str, str]] = []
    fsync = os.fsync

    def record_fsync(descriptor: int) -> None:
        seen.append(("fsync", os.readlink(f"/proc/self/fd/{descriptor}")))
        fsync(descriptor)

    monkeypatch.setattr(os, "fsync", record_fsync)

    def recorded(operation: Callable[[StrPath, StrPath], None]) -> Callable[[StrPath, StrPath], None]:
        def record(old: StrPath, new: StrPath) -> None:
            seen.append(("rename", str(new)))
            operation(old, new)

        return record

    monkeypatch.setattr(os, "replace", recorded(os.replace))
    monkeypatch.setattr(os, "rename", recorded(os.rename))
    return seen
