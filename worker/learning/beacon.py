"""The beacon of a rank: its progress messages to its supervisor, one JSON line each on an inherited pipe, without waiting."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from typing import Any


class Beacon:
    """Messages to the supervisor: ``phase`` (:class:`shared_store.contract.phases.Phase`), ``iteration`` and ``steps_per_second``, ``said`` (of a
    save), ``done``.

    A message that finds the pipe full is dropped: the supervisor wants the newest, and the loop must not wait for it.
    Without a supervisor (torchrun, a debugger) nothing is sent.
    """

    def __init__(self, env: Mapping[str, str] | None = None) -> None:
        given = (os.environ if env is None else env).get("MUSTER_PROGRESS_FD", "")
        self._descriptor = int(given) if given.isdecimal() else None

    def tell(self, **message: Any) -> None:
        """Send one message of JSON values."""
        if self._descriptor is None:
            return
        try:
            os.write(self._descriptor, json.dumps(message).encode() + b"\n")
        except BlockingIOError:
            pass
        except OSError:
            self._descriptor = None  # the supervisor no longer listens
