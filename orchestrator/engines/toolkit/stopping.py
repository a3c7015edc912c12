"""Stopping a gang through a backend that may never answer: the loop has an end, and the controller tries again later."""

from __future__ import annotations

from collections.abc import Callable

from orchestrator import machine
from orchestrator.engines.api import NotYet, Transient


def stop_within(seconds: float, step: Callable[[], str], *, engine: str, gang: str, pause: float) -> None:
    """Ask for a gang's end, and look, again and again until nothing of it is left.

    Args:
        seconds: Time for all of it. One step that takes longer is not broken off.
        step: Asks, where that is due, and looks; returns the gang's present state in words, empty once nothing of it is left. NotYet
            means that there is no answer: it is called again. Every other error ends the loop.
        engine: Name of the engine, for the error.
        gang: Name of the gang, for the error.
        pause: Seconds between two steps.

    Raises:
        Transient: The time is over; one line with the last answer.
    """
    deadline = machine.monotonic() + seconds
    while True:
        try:
            answer = step()
        except NotYet as error:
            answer = str(error)
        if not answer:
            return
        if machine.monotonic() >= deadline:
            raise Transient(
                f"the {engine} engine has not ended gang {gang} within {seconds:.3g} s; last answer: {answer}"
            )
        machine.sleep(pause)
