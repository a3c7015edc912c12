"""The gangs of stored jobs: each definition is read once, however often its job is loaded."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Mapping
from typing import Any

from orchestrator.domain.gang import GangSpec, gang_needs

_MOST = 1024
"""Number of definitions kept: enough for the running jobs and the latest submissions."""


class Gangs:
    """The gangs of the definitions used last. Any thread may call."""

    def __init__(self, most: int = _MOST) -> None:
        self._most, self._lock = most, threading.Lock()
        self._known: OrderedDict[str, tuple[Mapping[str, Any], GangSpec]] = OrderedDict()

    def of(self, job: str, node_properties: Mapping[str, Any]) -> GangSpec:
        """The gang of a job; a row that has changed is read again. Raises ValueError."""
        with self._lock:
            known = self._known.get(job)
            if known is not None and known[0] == node_properties:
                self._known.move_to_end(job)
                return known[1]
        gang = gang_needs(node_properties)
        self.remember(job, node_properties, gang)
        return gang

    def remember(self, job: str, node_properties: Mapping[str, Any], gang: GangSpec) -> None:
        """Keep ``gang``, as read from the job's node properties, which are not changed any more."""
        with self._lock:
            self._known[job] = node_properties, gang
            self._known.move_to_end(job)
            while len(self._known) > self._most:
                self._known.popitem(last=False)


gangs = Gangs()
"""Shared by all sessions of this process."""
