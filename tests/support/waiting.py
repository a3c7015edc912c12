"""Waiting for a condition: never for a time."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

PATIENCE = 6
"""Every limit of a wait is this many times what an idle machine could need: a limit is there to end a test that hangs."""


def wait_for(condition: Callable[[], Any], timeout: float = 60, what: str = "condition") -> Any:
    """Poll until ``condition`` gives something true; that is returned."""
    deadline = time.monotonic() + timeout * PATIENCE
    while time.monotonic() < deadline:
        if value := condition():
            return value
        time.sleep(0.05)
    raise AssertionError(f"{what}: not within {timeout * PATIENCE} s")
