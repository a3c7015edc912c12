"""Pauses between tries, and when they are forgotten."""

from __future__ import annotations

import logging

from orchestrator.engines.toolkit.backoff import Backoff


def test_what_is_not_tried_any_more_is_forgotten_and_what_still_waits_is_not() -> None:
    backoff = Backoff(logging.getLogger("test"), first=0.0)
    backoff.failed(("start", "over"), "can't start")
    waiting = Backoff(logging.getLogger("test"), first=60.0)
    waiting.failed(("start", "waits"), "can't start")
    for each in (backoff, waiting):
        each.tidy(idle=0.0)
    assert not backoff and waiting.said(("start", "waits")) == "can't start"
