"""The lineage of runs: which of them began with the weights of another."""

from __future__ import annotations

import threading
import time

from orchestrator.control.controller import Controller
from orchestrator.services.context import visible_runs
from orchestrator.services.permissions import Actor
from shared_store.volume.files import DamagedFile
from shared_store.volume.layout import Run

_KEPT = 600.0
"""Seconds for which the parent of a run is not read again: it changes only where the run is replaced by another of its name."""


def clones_of(controller: Controller, actor: Actor, run: Run) -> list[str]:
    """The runs that began with weights of ``run`` and that the caller may see, by name."""
    return [each.name for each in visible_runs(controller, actor) if _parents.of(each) == run.name]


class _Parents:
    """The parent of each run, read once in ten minutes. Any thread may call."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._known: dict[str, tuple[float, str | None]] = {}

    def of(self, run: Run) -> str | None:
        """The name of a run's parent; None where it has none, or can't be read."""
        key, now = str(run.path), time.monotonic()
        with self._lock:
            known = self._known.get(key)
        if known is not None and now - known[0] < _KEPT:
            return known[1]
        try:
            told = ((run.description() or {}).get("parent") or {}).get("run")
        except (DamagedFile, OSError):
            return None
        parent = told if isinstance(told, str) else None
        with self._lock:
            self._known[key] = now, parent
        return parent


_parents = _Parents()
