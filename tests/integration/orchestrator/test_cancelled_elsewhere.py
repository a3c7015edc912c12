"""Gangs that others than Muster cancel in the queue of their engine's own scheduler, on a fake engine that has one."""

from __future__ import annotations

import logging
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import pytest

from orchestrator.domain.job import Status
from orchestrator.engines.api import Cause
from orchestrator.engines.testing.fake import FakeEngine
from orchestrator.persistence.batch_models import ComputeEnvironment, Job
from shared_store.volume.node_outcomes import Outcome, write_outcome
from tests.support.orchestrator.fake_controller import FakeController, properties
from tests.support.waiting import wait_for

HOW = "cancelled in Slurm (scancel), not by Muster (job 7)"


@pytest.mark.parametrize("most", [None, 1])
def test_a_cancelled_gang_is_started_again_with_a_notice_until_its_limit(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, most: int | None
) -> None:
    caplog.set_level(logging.WARNING, "muster.controller")
    with ExitStack() as stack:
        bench = FakeController(tmp_path, FakeEngine(), stack)
        if most is not None:
            with bench.database.session() as session:
                session.get_one(ComputeEnvironment, "fake").tags = {"muster:cancellations": str(most)}
        bench.controller.start()
        cluster, limit = bench.engine.cluster, 3 if most is None else most
        gang = properties(1, nodes=2, MUSTER_ON_CHILD_FAILURE="restart")
        bench.submit("job", attempts_allowed=9, node_properties=gang)
        for attempt in range(1, limit + 2):
            name = f"job/{attempt}/{attempt}"
            wait_for(lambda name=name: name in cluster.gangs, 30, f"attempt {attempt}")
            bench.wait("job", Status.RUNNING)
            for index in range(2):
                left = Outcome(index, attempt, 75, None, "left on request", None, 1.0, 2.0, requested=True)
                write_outcome(bench.store.run("job"), "job", attempt, left)
                cluster.end(name, index, 75)
                cluster.gangs[name][index] = replace(cluster.gangs[name][index], cause=Cause.CANCELLED, words=HOW)
        reason = bench.wait("job", Status.FAILED).status_reason
        end = f"not started again after {limit + 1} cancellations: ask who did it before you resume it"
        assert reason == f"attempt {limit + 1} was {HOW}; {end}"
        with bench.database.session() as session:
            attempts = session.get_one(Job, "job").attempts
            found = [(each.ending, each.status_reason) for each in attempts]
        assert found == [("cancelled", HOW)] * (limit + 1)
        notes = [[node.contract.note for node in plan.nodes] for plan in cluster.launched]
        assert notes == [["", ""], *([f"muster: attempt {number} was {HOW}"] * 2 for number in range(1, limit + 1))]
        output = [record.getMessage() for record in caplog.records if HOW in record.getMessage()]
        assert output[0] == f"job job: attempt 1 was {HOW}; starting again (1 of {limit} times)"
        assert len(output) == limit + 1
