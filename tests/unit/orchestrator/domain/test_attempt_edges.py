"""Edges of the rules of an attempt, beside those in test_attempt.py."""

from __future__ import annotations

from dataclasses import replace

import pytest

from orchestrator.domain.attempt import Decide, Observed, Phase, Save, State, Stop, Terms, step
from orchestrator.domain.job import Ending, NodeEnd, Verdict
from orchestrator.domain.native_options import NativeOptions

NATIVE = NativeOptions(is_native=True, on_child_failure="fail")
LAUNCHING = State(Terms(1, ("h/0", "h/1"), 2, 0, NATIVE, 30.0))
STARTING = replace(LAUNCHING, launched=True)
RUNNING = replace(STARTING, started=True, running_since=1000)


def test_phases_follow_one_another() -> None:
    ending = replace(RUNNING, verdict=Verdict(Ending.FAILED, "why"))
    phases = [each.phase for each in (LAUNCHING, STARTING, RUNNING, ending, replace(ending, closed=True))]
    assert phases == list(Phase)
    assert replace(ending, launched=False).phase is Phase.LAUNCHING


def test_a_gang_that_failed_for_good_has_little_to_save() -> None:
    seen = Observed(2000, (None, NodeEnd(1, "exit 1", 1.0)), (None, None))
    assert step(RUNNING, seen)[1:] == (Decide(Verdict(Ending.FATAL, "node 1: exit 1", 1)), Save(), Stop(5.0))


def test_a_look_has_a_silence_for_every_node() -> None:
    with pytest.raises(ValueError):
        step(RUNNING, Observed(2000, (None, None), (None,)))
