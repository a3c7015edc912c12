"""Waiting for the effect of an engine's request."""

from __future__ import annotations

from collections.abc import Callable

from orchestrator import machine


def wait_until(condition: Callable[[], bool], seconds: float, pause: float = 0.05) -> bool:
    """Look again and again until the condition holds; whether it did within that time. Looks once at least."""
    deadline = machine.monotonic() + seconds
    while not condition():
        if machine.monotonic() >= deadline:
            return False
        machine.sleep(pause)
    return True
