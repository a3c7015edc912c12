"""The runner of an engine: what its caller never waits for, what is kept of a launch, and the engine's health."""

from __future__ import annotations

import time
import traceback
from collections.abc import Iterator

import pytest

from orchestrator.engines import runner as runner_module
from orchestrator.engines.api import Gang, Handle, NodePhase, NotYet, Plan, Traits, Transient
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
def runner(engine: FakeEngine) -> Iterator[Runner]:
    made = Runner(engine, lambda _: None)
    yield made
    engine.answers.set()
    made.close()


def test_a_stop_does_not_wait_for_ever_for_the_last_look_of_an_engine_that_hangs(
    engine: FakeEngine, runner: Runner, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(runner_module, "_LAST_POLL", 0.05)
    handle = engine.launch(engine.plan(GANG))
    engine.answers.clear()
    with pytest.raises(Transient, match=r"^the fake engine has not reported how the gang ended$"):
        runner.stop(handle, 1.0)
    engine.answers.set()
    monkeypatch.undo()
    assert [node.exit_code for node in runner.stop(handle, 1.0)] == [143, 143]


def test_an_engine_that_answers_for_fewer_gangs_than_it_was_asked_for_is_at_fault(
    engine: FakeEngine, runner: Runner, monkeypatch: pytest.MonkeyPatch
) -> None:
    handle = engine.launch(engine.plan(GANG))
    monkeypatch.setattr(engine, "observe", lambda handles: [])
    wait_for(lambda: runner.observe(handle), what="the answer")
    first, _ = runner.observe(handle) or []
    assert first.phase is NodePhase.UNREACHABLE and "ValueError" in first.words


@pytest.mark.parametrize("engine", [FullEngine()])
def test_a_launch_that_is_refused_again_and_again_keeps_no_trace_of_each_try(runner: Runner) -> None:
    def refusal() -> NotYet | None:
        try:
            runner.launch(GANG.name, lambda: runner.plan(GANG), again=False)
        except NotYet as error:
            return error if str(error) else None
        return None

    first = wait_for(refusal, 10, "the refusal")
    refusal()
    depth = len(list(traceback.walk_tb(first.__traceback__)))
    for _ in range(20):
        assert refusal() is first
    assert len(list(traceback.walk_tb(first.__traceback__))) == depth


class StuckEngine(FakeEngine):
    """Its launches hang, and nothing else does."""

    traits = Traits(launches=2)

    def launch(self, plan: Plan[Gang]) -> Handle:
        self.answers.wait()
        return super().launch(plan)

    def _called(self) -> None:
        """All other calls are answered."""


@pytest.mark.parametrize("engine", [StuckEngine()])
def test_launches_that_hang_are_named_and_hold_up_no_look(
    engine: FakeEngine, runner: Runner, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(runner_module, "OVERDUE", 0.1)
    engine.answers.clear()
    gangs = [make_gang(f"job-{number}", "/store", 1, "fake/host", ["true"]) for number in range(3)]

    def words() -> list[str]:
        found = []
        for gang in gangs:
            try:
                runner.launch(gang.name, lambda gang=gang: runner.plan(gang))  # type: ignore[misc]
            except NotYet as wait:
                found.append(str(wait))
        return found

    output = wait_for(lambda: all(found := words()) and found, 10, "that launches hang")
    assert len(output) == 3 and all(
        each.startswith("the fake engine has not answered a launch since ") for each in output
    )
    assert runner.health.problem == output[0] and runner.silence is None
    assert runner.capacity(10.0) is not None
    engine.answers.set()
    wait_for(lambda: not words(), 10, "that all are launched")
    assert runner.health.problem is None


def test_a_launch_whose_handle_could_not_be_recorded_is_not_asked_for_again(engine: FakeEngine, runner: Runner) -> None:
    def launch() -> Handle | None:
        try:
            return runner.launch(GANG.name, lambda: engine.plan(GANG))
        except NotYet:
            return None

    handle = wait_for(launch, 10, "the launch")
    del engine.cluster.gangs[GANG.name]  # an engine that has forgotten it would start it anew
    assert launch() == handle and len(engine.cluster.launched) == 1
    assert runner.launch_pause(GANG.name) == 0
    runner.forget(GANG.name, handle)
    assert wait_for(launch, 10, "another launch") == handle and len(engine.cluster.launched) == 2


def test_an_engine_s_health_says_when_it_answered_last_why_it_fails_and_that_it_hangs(
    engine: FakeEngine, runner: Runner, monkeypatch: pytest.MonkeyPatch
) -> None:
    runner.capacity(patience=10)
    reported = runner.health.reported_at
    assert reported is not None and time.time() * 1000 - 60_000 < reported <= time.time() * 1000
    assert (runner.health.problem, runner.health.failing, runner.health.retry) == (None, 0, None)
    engine.error = Transient("the daemon refuses the connection")
    runner.capacity(patience=10)
    assert runner.health.problem == "the daemon refuses the connection" and runner.health.reported_at == reported
    engine.error = None
    runner.capacity(patience=10)
    assert runner.health.problem is None
    monkeypatch.setattr(runner_module, "OVERDUE", 0.1)
    engine.answers.clear()
    runner.capacity()
    output = str(wait_for(lambda: runner.health.problem, 10, "the silence"))
    assert "the fake engine has not answered since" in output
    engine.answers.set()
    wait_for(lambda: runner.health.problem is None, 10, "the recovery")
