"""Instructions of the attempt's state machine, carried out on a database."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import pytest

from orchestrator.control import attempts
from orchestrator.domain.attempt import Event, Instructions, Phase, State, after, step
from orchestrator.domain.job import Status
from orchestrator.engines.api import NodePhase, NodeStatus, NotYet
from orchestrator.engines.testing.fake import FakeEngine
from orchestrator.persistence.models import Job
from tests.support.orchestrator.fake_controller import FakeController, properties


def test_an_attempt_is_read_back_as_the_state_machine_left_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    left: dict[int, State] = {}
    """By number of the attempt."""
    found: list[tuple[State, State]] = []
    phases: set[Phase] = set()

    def recorded(state: State, event: Event) -> Instructions:
        number, instructions = state.terms.number, step(state, event)
        phases.add(state.phase)
        if number in left:  # a request may have asked the job to end meanwhile
            found.append((left[number], replace(state, stop_reason=left[number].stop_reason)))
        for instruction in instructions:
            state = after(state, instruction)
        left[number] = state
        return instructions

    monkeypatch.setattr(attempts, "step", recorded)
    with ExitStack() as stack:
        bench = FakeController(tmp_path, FakeEngine(), stack)
        bench.reconciler.start()
        engine, gangs = bench.engine, bench.engine.cluster.gangs
        engine.error = NotYet("no room yet")
        gang = properties(1, nodes=2, MUSTER_ON_CHILD_FAILURE="restart")
        bench.submit("job", attempts_allowed=2, node_properties=gang)
        bench.explains("job", "no room yet")
        engine.error = None
        assert bench.wait("job", Status.RUNNING).status_reason == "attempt 1 runs on 2 nodes"
        gangs["job/1/1"][0] = NodeStatus(NodePhase.UNREACHABLE, words="out of sight")
        bench.explains("job", "out of sight")
        engine.cluster.end("job/1/1", 1, 3, "exit 3")
        bench.explains("job", "attempt 2 runs on 2 nodes")
        with bench.database.session() as session:
            session.get_one(Job, "job").stop_reason = "enough"
        bench.wait("job", Status.FAILED)
        with bench.database.session() as session:
            job = session.get_one(Job, "job")
            ends = [(each.ending, each.status_reason, each.exit_code, each.spent) for each in job.attempts]
    assert ends == [("failed", "node 1: exit 3", 3, True), ("stopped", "enough", None, True)]
    assert phases == {Phase.LAUNCHING, Phase.STARTING, Phase.RUNNING, Phase.ENDING}
    assert all(left[number].closed for number in (1, 2))
    for expected, state in found:
        assert state == expected
