"""The thread of an engine: what its caller never waits for, and what is kept of a launch that can't be made yet."""

from __future__ import annotations

import traceback
from collections.abc import Iterator

import pytest

from orchestrator.engines import runner
from orchestrator.engines.api import Gang, Handle, NotYet, Plan, Transient
from orchestrator.engines.runner import Runner
from orchestrator.engines.testing.fake import FakeEngine
from orchestrator.engines.testing.rigs import make_gang
from tests.support.waiting import wait_for

GANG = make_gang("job", "/store", 2, "fake/host", ["true"])


class FullEngine(FakeEngine):
    """It has no room."""

    def launch(self, plan: Plan[Gang]) -> Handle:
        raise NotYet("no room yet")


@pytest.fixture
def engine() -> FakeEngine:
    return FakeEngine()


@pytest.fixture
def asked(engine: FakeEngine) -> Iterator[Runner]:
    made = Runner(engine, lambda _: None)
    yield made
    engine.answers.set()
    made.close()


def test_a_stop_does_not_wait_for_ever_for_the_last_look_of_an_engine_that_hangs(
    engine: FakeEngine, asked: Runner, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(runner, "_LAST_LOOK", 0.05)
    handle = engine.launch(engine.plan(GANG))
    engine.answers.clear()
    with pytest.raises(Transient, match=r"^the fake engine has not reported how the gang ended$"):
        asked.stop(handle, 1.0)
    engine.answers.set()
    monkeypatch.undo()
    assert [node.exit_code for node in asked.stop(handle, 1.0)] == [143, 143]


@pytest.mark.parametrize("engine", [FullEngine()])
def test_a_launch_that_is_refused_again_and_again_keeps_no_trace_of_each_try(asked: Runner) -> None:
    def refusal() -> NotYet | None:
        try:
            asked.launch(GANG.name, lambda: asked.plan(GANG), again=False)
        except NotYet as error:
            return error if str(error) else None
        return None

    first = wait_for(refusal, 10, "the refusal")
    refusal()
    depth = len(list(traceback.walk_tb(first.__traceback__)))
    for _ in range(20):
        assert refusal() is first
    assert len(list(traceback.walk_tb(first.__traceback__))) == depth
