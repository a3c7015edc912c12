"""Waiting for the effect of a request: every wait has an end, also where the backend never answers."""

from __future__ import annotations

from collections.abc import Callable

from orchestrator import machine
from orchestrator.engines.api import NotYet, Transient


def wait_until(condition: Callable[[], bool], seconds: float, pause: float = 0.05) -> bool:
    """Check the condition, at least once, until it holds; returns whether it did within that time."""
    deadline = machine.monotonic() + seconds
    while not condition():
        if machine.monotonic() >= deadline:
            return False
        machine.sleep(pause)
    return True


def stop_within(seconds: float, step: Callable[[], str], *, engine: str, gang: str, pause: float) -> None:
    """Repeat a step of stopping a gang until nothing of the gang is left.

    Args:
        seconds: Time for all of it. A step that takes longer is not broken off.
        step: Requests the end, where that is due; returns the gang's present state in words, empty once nothing of it is left. On
            NotYet (no response) it is called again; every other error ends the loop.
        engine, gang: Their names, for the error.
        pause: Seconds between two steps.

    Raises:
        Transient: The time is over; one line with the last answer. The controller tries again later.
    """
    answer = ""

    def is_over() -> bool:
        nonlocal answer
        try:
            answer = step()
        except NotYet as error:
            answer = str(error)
        return not answer

    if not wait_until(is_over, seconds, pause):
        raise Transient(f"the {engine} engine has not ended gang {gang} within {seconds:.3g} s; last answer: {answer}")
