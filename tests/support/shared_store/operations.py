"""What a program does to make its files durable."""

from __future__ import annotations

import os

import pytest


def durable_operations(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, str]]:
    """Every fsync and rename from now on, in order, as (operation, path); they are carried out as ever."""
    seen: list[tuple[str, str]] = []
    fsync, replace, rename = os.fsync, os.replace, os.rename

    def record_fsync(descriptor: int) -> None:
        seen.append(("fsync", os.readlink(f"/proc/self/fd/{descriptor}")))
        fsync(descriptor)

    monkeypatch.setattr(os, "fsync", record_fsync)
    monkeypatch.setattr(os, "replace", lambda old, new: (seen.append(("rename", str(new))), replace(old, new)))
    monkeypatch.setattr(os, "rename", lambda old, new: (seen.append(("rename", str(new))), rename(old, new)))
    return seen
