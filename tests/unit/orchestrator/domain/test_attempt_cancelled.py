"""The rules of an attempt whose gang others cancelled, beside those in test_attempt.py."""

from __future__ import annotations

from dataclasses import replace

import pytest

from orchestrator.domain import attempt_instructions as do
from orchestrator.domain.attempt import SHORTEST_REQUEUE, AttemptState, Terms, step
from orchestrator.domain.attempt_events import Gone
from orchestrator.domain.job import Ending, NodeEnd, Status, Verdict
from orchestrator.domain.native_options import NativeOptions

T = 1_000_000
"""The moment of every event here (steady time [ms])."""
NATIVE = NativeOptions(is_native=True, on_child_failure="restart")
TERMS = Terms(number=2, hosts=("h/0", "h/1"), whole=2, main=0, options=NATIVE, grace=30.0, allowed=3, spent=1)
ENDING = AttemptState(
    TERMS,
    prepared=True,
    launched=True,
    started=True,
    running_since=T - 50_000,
    verdict=Verdict(Ending.REQUEUE, "left on request", 75),
)
SAVED = "; last checkpoint: iteration 7"
HOW = "cancelled in Slurm (scancel), not by Muster (job 7)"


@pytest.mark.parametrize(
    ("before", "most", "allowed", "status", "words"),
    [
        (0, 3, 3, Status.RUNNABLE, "; starting again (1 of 3 times)"),
        (2, 3, 3, Status.RUNNABLE, "; starting again (3 of 3 times)"),
        (3, 3, 99, Status.FAILED, "; not started again after 4 cancellations: ask who did it before you resume it"),
        (0, 0, 99, Status.FAILED, "; not started again after 1 cancellation: ask who did it before you resume it"),
    ],
)
def test_a_gang_that_others_cancel_is_started_again_a_bounded_number_of_times(
    before: int, most: int, allowed: int, status: Status, words: str
) -> None:
    state = ENDING
    state = replace(state, terms=replace(TERMS, cancelled=before, allowed=allowed))
    gone = Gone(T, (NodeEnd(75, "left on request", 1.0, requested=True),) * 2, SAVED, HOW, most)
    (close,) = step(state, gone)
    assert close == do.Close(T, False, status, f"attempt 2 was {HOW}{SAVED}{words}", HOW)


def test_a_gang_that_others_cancel_at_once_spends_an_attempt_and_one_that_its_user_stops_is_stopped() -> None:
    state = replace(ENDING, running_since=T - SHORTEST_REQUEUE + 1)
    gone = Gone(T, (), SAVED, HOW, 3)
    (close,) = step(replace(state, terms=replace(TERMS, allowed=3, spent=1)), gone)
    assert isinstance(close, do.Close) and (close.spent, close.status) == (True, Status.RUNNABLE)
    (close,) = step(replace(state, terms=replace(TERMS, allowed=2, spent=2)), gone)
    assert isinstance(close, do.Close) and (close.spent, close.status) == (True, Status.FAILED)
    (close,) = step(replace(state, stop_reason="enough"), gone)
    assert close == do.Close(T, True, Status.FAILED, f"enough{SAVED}")
