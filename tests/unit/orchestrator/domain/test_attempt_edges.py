"""Edges of the rules of an attempt, beside those in test_attempt.py."""

from __future__ import annotations

from dataclasses import replace

import pytest

from orchestrator.domain import attempt_instructions as do
from orchestrator.domain.attempt import SHORTEST_REQUEUE, AttemptPhase, AttemptState, Terms, after, step
from orchestrator.domain.attempt_events import (
    Delayed,
    Due,
    Event,
    Gone,
    Launched,
    Observed,
    Preempted,
    Prepared,
    Refused,
)
from orchestrator.domain.job import Ending, NodeEnd, Status, Verdict
from orchestrator.domain.native_options import NativeOptions

NATIVE = NativeOptions(is_native=True, on_child_failure="fail")
PREPARING = AttemptState(Terms(1, ("h/0", "h/1"), 2, 0, NATIVE, 30.0))
LAUNCHING = replace(PREPARING, prepared=True)
STARTING = replace(LAUNCHING, launched=True)
RUNNING = replace(STARTING, started=True, running_since=1000)


def test_phases_follow_one_another() -> None:
    ending = replace(RUNNING, verdict=Verdict(Ending.FAILED, "why"))
    phases = [each.phase for each in (PREPARING, LAUNCHING, STARTING, RUNNING, ending, replace(ending, closed=True))]
    assert phases == list(AttemptPhase)
    assert replace(ending, launched=False).phase is AttemptPhase.LAUNCHING


def test_a_gang_that_failed_for_good_has_little_to_save() -> None:
    seen = Observed(2000, (None, NodeEnd(1, "exit 1", 1.0)), (None, None))
    decided = do.Decide(Verdict(Ending.FATAL, "node 1: exit 1", 1))
    stop = do.Stop(5.0, "node 1: exit 1; its nodes are ending")
    assert [each for each in step(RUNNING, seen) if not isinstance(each, do.Explain)] == [decided, do.Save(), stop]


def test_a_look_has_a_silence_for_every_node() -> None:
    with pytest.raises(ValueError):
        step(RUNNING, Observed(2000, (None, None), (None,)))


def test_who_leaves_on_request_after_a_while_starts_again_though_no_attempt_is_left() -> None:
    left = replace(RUNNING, terms=replace(RUNNING.terms, spent=1), verdict=Verdict(Ending.REQUEUE, "why"))
    [close] = step(left, Gone(1000 + SHORTEST_REQUEUE, (), ""))
    assert isinstance(close, do.Close) and (close.status, close.spent) == (Status.RUNNABLE, False)


def test_what_is_known_after_each_instruction() -> None:
    verdict = Verdict(Ending.FAILED, "why")
    assert after(PREPARING, do.TakeEpoch(7)) == LAUNCHING
    assert after(LAUNCHING, do.Keep("handle")) == STARTING
    assert after(STARTING, do.MarkRunning("runs", 1000)) == RUNNING
    assert after(RUNNING, do.Await("cause_since", 5)) == replace(RUNNING, cause_since=5)
    assert after(RUNNING, do.Await("done_since", 6)) == replace(RUNNING, done_since=6)
    assert after(RUNNING, do.Decide(verdict)) == replace(RUNNING, verdict=verdict)
    assert after(RUNNING, do.Close(9, True, Status.FAILED, "why")) == replace(RUNNING, closed=True)
    assert after(RUNNING, do.Explain("why")) == RUNNING


EVENTS = (
    *(
        Due(),
        Prepared(7),
        Delayed("why", idle=True),
        Refused("why"),
        Launched("handle"),
        Delayed("why", idle=True),
        Refused("why"),
        Preempted("why"),
        Observed(2000, (None, None), (None, None)),
    ),
    *(Delayed("why"), Gone(2000, (NodeEnd(0, "exit 0", 1.0), NodeEnd(0, "exit 0", 1.0)), "")),
)


@pytest.mark.parametrize("event", EVENTS, ids=lambda event: type(event).__name__)
def test_nothing_follows_from_an_event_of_a_closed_attempt(event: Event) -> None:
    closed = replace(RUNNING, verdict=Verdict(Ending.FAILED, "why"), closed=True)
    assert closed.phase is AttemptPhase.CLOSED and step(closed, event) == ()
