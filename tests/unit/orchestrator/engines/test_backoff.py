"""Pauses between tries, and when they are forgotten."""

from __future__ import annotations

import logging

import pytest

from orchestrator.engines.toolkit import backoff as module
from orchestrator.engines.toolkit.backoff import Backoff


def test_an_action_that_is_not_tried_any_more_is_forgotten_and_a_waiting_one_is_kept() -> None:
    backoff = Backoff(logging.getLogger("test"), first=0.0)
    backoff.failed(("start", "over"), "can't start")
    waiting = Backoff(logging.getLogger("test"), first=60.0)
    waiting.failed(("start", "waits"), "can't start")
    for each in (backoff, waiting):
        each.tidy(idle=0.0)
    assert not backoff and waiting.said(("start", "waits")) == "can't start"


def test_an_action_that_fails_at_every_other_try_is_logged_once_and_waits_longer_each_time(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    moment = 0.0
    monkeypatch.setattr(module.time, "monotonic", lambda: moment)
    backoff = Backoff(logging.getLogger("test"), first=1.0, most=60.0)
    for pause in (1.0, 2.0, 4.0):
        backoff.failed("job", "can't end")
        moment += pause - 0.1
        assert backoff.waits("job")
        moment += 0.1
        assert not backoff.waits("job") and not backoff.worked("job", lasting=True)
    assert [record.getMessage() for record in caplog.records] == ["can't end"]
    moment += 3.9
    assert not backoff.worked("job", lasting=True) and backoff.said("job") == "can't end"
    moment += 0.1
    assert backoff.worked("job", lasting=True) and not backoff
