"""A controller on a fake engine. Jobs on which an engine or the controller fails again and again: the others start and end meanwhile."""

from __future__ import annotations

import itertools
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest import mock

import pytest
from sqlalchemy import update

from orchestrator.control import attempts
from orchestrator.control.attempts import Attempts
from orchestrator.control.exposition import exposition
from orchestrator.domain.attempt import AttemptPhase, AttemptState, after, step
from orchestrator.domain.attempt_events import Event
from orchestrator.domain.attempt_instructions import Instructions
from orchestrator.domain.hosts import Host, Hosts
from orchestrator.domain.job import Status
from orchestrator.domain.reasons import Reason
from orchestrator.engines.api import (
    CannotStart,
    Gang,
    GangStatus,
    Handle,
    NodePhase,
    NodeStatus,
    NotYet,
    Plan,
)
from orchestrator.engines.testing.fake import FakeEngine
from orchestrator.persistence.batch_models import Attempt, Job, Node
from orchestrator.persistence.session import DatabaseError
from tests.support.orchestrator.fake_controller import FakeController, properties
from tests.support.orchestrator.rows import job
from tests.support.waiting import wait_for


class PoisonedEngine(FakeEngine):
    """Its calls for one job raise: a bug of an engine that this job brings out."""

    poisoned = "bad"

    def __init__(self) -> None:
        super().__init__(capacity=Hosts([Host("fake/large", 8.0, (), 8192), Host("fake/small", 4.0, (), 8192)]))
        self.raises: dict[str, BaseException] = {}
        """By name of the call."""
        self.tries = Counter[str]()

    def plan(self, gang: Gang) -> Plan[Gang]:
        self._check("plan", gang.job)
        return super().plan(gang)

    def launch(self, plan: Plan[Any]) -> Handle:
        self._check("launch", plan.gang.job)
        return super().launch(plan)

    def _observe(self, handle: Handle) -> GangStatus:
        self._check("observe", handle.gang.partition("/")[0])
        return super()._observe(handle)

    def stop(self, handle: Handle, grace: float) -> None:
        self._check("stop", handle.gang.partition("/")[0])
        super().stop(handle, grace)

    def _check(self, call: str, job_id: str) -> None:
        if job_id == self.poisoned and (error := self.raises.get(call)) is not None:
            self.tries[call] += 1
            raise error


Bench = FakeController[PoisonedEngine]


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    with ExitStack() as stack:
        made = FakeController(tmp_path, PoisonedEngine(), stack)
        made.controller.start()
        yield made


GOES_WRONG = {
    "plan": "the fake engine failed to plan the gang (RuntimeError: no words for it)",
    "launch": "the fake engine failed to start the gang (RuntimeError: no words for it)",
    "observe": "the fake engine failed to look at the gang (RuntimeError: no words for it)",
    "stop": "attempt 1 can't be stopped: the fake engine failed to stop the gang (RuntimeError: no words for it)",
}


@pytest.mark.parametrize("call", GOES_WRONG)
def test_a_bug_of_an_engine_holds_up_one_job_logged_once(
    bench: Bench, caplog: pytest.LogCaptureFixture, call: str
) -> None:
    began = time.monotonic()
    bench.engine.raises[call] = RuntimeError("no\nwords for it")
    bench.submit("bad")
    if call == "stop":
        bench.wait("bad", Status.RUNNING)
        with bench.database.session() as session:
            session.get_one(Job, "bad").stop_reason = "enough"
    bench.explains("bad", GOES_WRONG[call])
    bench.runs_and_ends("good-0", "good-1")
    wait_for(lambda: bench.engine.tries[call] > 1, 30, "another try")
    bench.runs_and_ends("good-2")
    tries, passed = bench.engine.tries[call], time.monotonic() - began
    reported = f"{tries} tries within {passed:.1f} s: each pause doubles, from one second on"
    assert 2 ** (tries - 1) - 1 <= passed, reported
    tracebacks = [record for record in caplog.records if record.exc_info]
    assert len(tracebacks) == 1 and GOES_WRONG[call] in tracebacks[0].getMessage(), caplog.text
    assert bench.job("bad").status in (Status.STARTING, Status.RUNNING)
    assert bench.job("bad").status_reason.endswith("trying again")
    bench.engine.raises.clear()
    if call == "stop":
        assert bench.wait("bad", Status.FAILED).status_reason == "enough"
    else:
        bench.wait("bad", Status.RUNNING)
        wait_for(lambda: bench.job("bad").status_reason == "attempt 1 runs on 2 nodes", 30, "that it is well again")


def test_an_engine_that_wants_to_end_the_process_ends_neither_its_thread_nor_the_controller_s(bench: Bench) -> None:
    bench.engine.raises["launch"] = bench.engine.raises["plan"] = SystemExit(3)
    bench.submit("bad")
    bench.explains("bad", "failed to plan the gang (SystemExit: 3)")
    del bench.engine.raises["plan"]
    bench.explains("bad", "failed to start the gang (SystemExit: 3)")
    bench.runs_and_ends("good")
    bench.engine.raises.clear()
    bench.wait("bad", Status.RUNNING)


HALF = "a name with half a character: \udcff"
"""As the name of a file has it that isn't UTF-8: no database can store it."""


def test_a_container_that_the_engine_can_t_start_fails_each_attempt_and_rules_see_aws_s_reasons(bench: Bench) -> None:
    pull = "CannotPullContainerError: no space left on device"
    bench.engine.raises["launch"] = CannotStart(pull)
    again = {"onStatusReason": "Task failed to start", "onReason": "CannotPullContainerError*", "action": "RETRY"}
    bench.submit("bad", attempts_allowed=3, own_evaluate_on_exit=[again, {"onReason": "*", "action": "EXIT"}])
    bench.wait("bad", Status.FAILED)
    with bench.database.session() as session:
        found = session.get_one(Job, "bad")
        reasons = [(each.status_reason, each.nodes[0].reason) for each in found.attempts]
        assert reasons == [("Task failed to start", pull)] * 3
        assert found.reason == Reason(f"can't start the gang: {pull}", "Task failed to start")


@pytest.mark.parametrize(
    ("part", "words"),
    [("begin", "no words for it"), ("advance", HALF), ("preempt", "no words for it")],
    ids=["begin", "advance", "preempt"],
)
def test_a_bug_of_the_controller_holds_up_one_job_and_is_logged_once(
    bench: Bench, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, part: str, words: str
) -> None:
    whole, tries = getattr(Attempts, part), list[float]()

    def poisoned(attempts: Attempts, session: Any, found: Job, *more: Any) -> Any:
        if found.id == "bad":
            tries.append(time.monotonic())
            raise RuntimeError(words)
        return whole(attempts, session, found, *more)

    monkeypatch.setattr(Attempts, part, poisoned)
    bench.submit("bad", node_properties=properties(5, MUSTER_PREEMPTIBLE="1"))
    if part == "preempt":
        bench.wait("bad", Status.RUNNING)
        bench.submit("urgent", node_properties=properties(8), queue="urgent")
    shown = words.replace("\udcff", "\\udcff")
    bench.explains("bad", f"the controller failed on this job (RuntimeError: {shown}); trying again")
    bench.runs_and_ends("good-0", "good-1")
    wait_for(lambda: len(tries) > 1, 30, "another try")
    bench.runs_and_ends("good-2")
    pauses = [after - before for before, after in itertools.pairwise(tries)]
    assert all(pause >= 2**number for number, pause in enumerate(pauses)), pauses
    tracebacks = [record.getMessage() for record in caplog.records if record.exc_info]
    assert tracebacks == [f"job bad: the controller failed on this job (RuntimeError: {shown}); trying again"]
    monkeypatch.undo()
    bench.wait("urgent" if part == "preempt" else "bad", Status.RUNNING)


@pytest.mark.parametrize("damaged", [{}, {"numNodes": 1}, {"numNodes": "x", "mainNode": 0}], ids=str)
def test_a_row_that_says_nothing_of_a_gang_that_runs_keeps_no_other_job_from_starting_and_no_metric_from_being_read(
    bench: Bench, caplog: pytest.LogCaptureFixture, damaged: dict[str, Any]
) -> None:
    nodes = [Node(index=0, host="fake/small", cpus=1.0, memory=64)]
    with bench.database.session() as session:
        row = job("bad", status=Status.RUNNING, node_properties=damaged)
        row.attempts.append(Attempt(number=1, epoch=1, nodes=nodes, compute_environment="fake"))
        session.add(row)
    bench.explains("bad", "the controller failed on this job")
    bench.runs_and_ends("good-0", "good-1")
    assert b'muster_cpus_in_use{engine="fake",queue="default"} 1.0' in exposition(bench.controller)
    [failed] = [record.getMessage() for record in caplog.records if record.exc_info]
    assert failed.startswith("job bad: the controller failed on this job")


# -- every instruction of the attempt's state machine ------------------------------------------------------------------


def test_an_attempt_is_read_back_as_the_state_machine_left_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    left: dict[int, AttemptState] = {}
    """By number of the attempt."""
    found: list[tuple[AttemptState, AttemptState]] = []
    phases: set[AttemptPhase] = set()

    def recorded(state: AttemptState, event: Event) -> Instructions:
        number, instructions = state.terms.number, step(state, event)
        phases.add(state.phase)
        if number in left:  # a request may have asked the job to end meanwhile
            found.append((left[number], replace(state, stop_reason=left[number].stop_reason)))
        for instruction in instructions:
            state = after(state, instruction)
        left[number] = state
        return instructions

    def read_anew(self: Attempts, job: Job, attempt: Attempt) -> Any:
        self.forget_states([job.id])
        return opened(self, job, attempt)

    opened = Attempts._opened
    monkeypatch.setattr(Attempts, "_opened", read_anew)
    monkeypatch.setattr(attempts, "step", recorded)
    with ExitStack() as stack:
        bench = FakeController(tmp_path, FakeEngine(), stack)
        bench.controller.start()
        engine, gangs = bench.engine, bench.engine.cluster.gangs
        engine.error = NotYet("no room yet")
        gang = properties(1, nodes=2, MUSTER_ON_CHILD_FAILURE="restart")
        bench.submit("job", attempts_allowed=2, node_properties=gang)
        bench.explains("job", "no room yet")
        engine.error = None
        assert bench.wait("job", Status.RUNNING).status_reason == "attempt 1 runs on 2 nodes"
        gangs["job/1/1"][0] = NodeStatus(NodePhase.UNREACHABLE, words="unreachable now")
        bench.explains("job", "unreachable now")
        engine.cluster.end("job/1/1", 1, 3)
        bench.explains("job", "attempt 2 runs on 2 nodes")
        with bench.database.session() as session:
            session.get_one(Job, "job").stop_reason = "enough"
        bench.wait("job", Status.FAILED)
        with bench.database.session() as session:
            job = session.get_one(Job, "job")
            ends = [(each.ending, each.status_reason, each.exit_code, each.spent) for each in job.attempts]
    assert ends == [("failed", "node 1: exit 3, outcome not written", 3, True), ("stopped", "enough", None, True)]
    assert phases == set(AttemptPhase) - {AttemptPhase.CLOSED}
    assert all(left[number].closed for number in (1, 2))
    for expected, state in found:
        assert state == expected


def test_what_another_controller_changed_meanwhile_counts_once_the_database_is_back(bench: Bench) -> None:
    bench.submit("a", "b")
    for name in ("a", "b"):
        bench.wait(name, Status.RUNNING)
    database = bench.controller.database
    bench.controller._kept = 0.0
    with mock.patch.object(database, "keep_lock", side_effect=DatabaseError("another controller has it")):
        wait_for(lambda: bench.controller.trouble, 20, "that the lock is missed")
        with database.engine.begin() as other:  # as the other controller does: this one is not notified
            other.execute(update(Job).where(Job.id == "a").values(stop_reason="enough"))
            moment = {"stopped_at": 1, "ending": "stopped", "spent": True}
            other.execute(update(Attempt).where(Attempt.job_id == "b").values(**moment))
            other.execute(update(Job).where(Job.id == "b").values(status="FAILED", status_reason="ended there"))
    assert bench.wait("a", Status.FAILED).status_reason == "enough"
    assert bench.job("b").status_reason == "ended there"
    wait_for(lambda: not bench.controller.bus.presence.expected(), 20, "that no gang is expected")
