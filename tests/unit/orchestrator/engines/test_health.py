"""An engine's health as a person sees it: it answers, it fails and is tried again, or it does not answer."""

from __future__ import annotations

import time
from collections.abc import Iterator

import pytest

from orchestrator.engines import runner
from orchestrator.engines.api import Transient
from orchestrator.engines.runner import Runner
from orchestrator.engines.testing.fake import FakeEngine
from tests.conftest import wait_for


@pytest.fixture
def served() -> Iterator[tuple[FakeEngine, Runner]]:
    engine = FakeEngine()
    asked = Runner(engine, lambda: None)
    asked.capacity(patience=10)
    yield engine, asked
    engine.answers.set()
    asked.close()


def test_an_engine_s_health_has_the_time_of_its_last_answer(served: tuple[FakeEngine, Runner]) -> None:
    health = served[1].health
    assert health.told_at is not None and time.time() * 1000 - 60_000 < health.told_at <= time.time() * 1000
    assert (health.problem, health.failing, health.retry) == (None, 0, None)


def test_an_engine_that_fails_says_why_and_keeps_the_time_of_its_last_answer(
    served: tuple[FakeEngine, Runner],
) -> None:
    engine, asked = served
    told = asked.health.told_at
    engine.error = Transient("the daemon refuses the connection")
    asked.capacity(patience=10)
    assert asked.health.problem == "the daemon refuses the connection" and asked.health.told_at == told
    engine.error = None
    asked.capacity(patience=10)
    assert asked.health.problem is None


def test_an_engine_that_hangs_is_said_not_to_answer(
    served: tuple[FakeEngine, Runner], monkeypatch: pytest.MonkeyPatch
) -> None:
    engine, asked = served
    monkeypatch.setattr(runner, "OVERDUE", 0.1)
    engine.answers.clear()
    asked.capacity()
    assert "the fake engine has not answered since" in str(wait_for(lambda: asked.health.problem, 10, "the silence"))
    engine.answers.set()
    wait_for(lambda: asked.health.problem is None, 10, "the recovery")
