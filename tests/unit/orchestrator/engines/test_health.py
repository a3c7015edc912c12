"""An engine's health as a person sees it: it answers, it fails and is tried again, or it does not answer."""

from __future__ import annotations

import time

import pytest

from orchestrator.engines import runner
from orchestrator.engines.api import Transient
from orchestrator.engines.runner import Runner
from orchestrator.engines.testing.fake import FakeEngine
from tests.conftest import wait_for


def test_an_engine_s_health_says_when_it_answered_last_why_it_fails_and_that_it_hangs(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    engine = FakeEngine()
    asked = Runner(engine, lambda: None)
    try:
        asked.capacity(patience=10)
        told = asked.health.told_at
        assert told is not None and time.time() * 1000 - 60_000 < told <= time.time() * 1000
        assert (asked.health.problem, asked.health.failing, asked.health.retry) == (None, 0, None)
        engine.error = Transient("the daemon refuses the connection")
        asked.capacity(patience=10)
        assert asked.health.problem == "the daemon refuses the connection" and asked.health.told_at == told
        engine.error = None
        asked.capacity(patience=10)
        assert asked.health.problem is None
        monkeypatch.setattr(runner, "OVERDUE", 0.1)
        engine.answers.clear()
        asked.capacity()
        said = str(wait_for(lambda: asked.health.problem, 10, "the silence"))
        assert "the fake engine has not answered since" in said
        engine.answers.set()
        wait_for(lambda: asked.health.problem is None, 10, "the recovery")
    finally:
        engine.answers.set()
        asked.close()
