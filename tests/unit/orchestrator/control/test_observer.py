"""What the controller makes of the nodes' ends and of the outcomes that they leave, whichever comes first."""

from __future__ import annotations

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import pytest

from orchestrator.control.observer import Observer
from orchestrator.control.presence import Presence
from orchestrator.control.run_store import Errands, StoreUnavailable
from orchestrator.domain.attempt_events import Observed
from orchestrator.engines.api import Cause, GangStatus, NodePhase, NodeStatus
from orchestrator.engines.toolkit.statuses import ended
from orchestrator.persistence.batch_models import Attempt, Node
from shared_store.volume.node_outcomes import Outcome
from tests.support.orchestrator.rows import job
from tests.support.orchestrator.slow_pool import SlowPool

ABSENT = NodeStatus(NodePhase.UNREACHABLE, words="the engine is away")


class Gang:
    """A gang of two nodes, the pool for the store, and the outcomes there. Without an ``endpoint`` the bus is off."""

    def __init__(self, endpoint: str | None = "tcp/127.0.0.1:7447") -> None:
        self.presence = Presence()
        self.pool, self.written, self.status = SlowPool(), dict[int, Outcome](), list[NodeStatus]()
        errands = Errands(self.pool, "/store", lambda _: None)
        engine = SimpleNamespace(observe=lambda _: self.status, status_age=lambda _: 0.0)
        self.observer = Observer(
            engine,  # type: ignore[arg-type]
            SimpleNamespace(outcomes=self._outcomes),  # type: ignore[arg-type]
            errands,
            SimpleNamespace(presence=self.presence, endpoint=endpoint),  # type: ignore[arg-type]
            SimpleNamespace(now=lambda: 0),  # type: ignore[arg-type]
        )
        self.job = job("job")
        nodes = [Node(index=index, host=f"h{index}") for index in range(2)]
        self.job.attempts = [Attempt(number=1, epoch=1, job_id="job", handle="{}", nodes=nodes, created_at=0)]

    def _outcomes(self, _run: str, _job: str, _attempt: int, nodes: Sequence[int]) -> dict[int, Outcome]:
        return {index: self.written[index] for index in nodes if index in self.written}

    def poll(self, *status: NodeStatus) -> Any:
        self.status = list[NodeStatus](status)
        return self.observer.observe(self.job, self.job.attempts[0])

    def write(self, index: int, code: int) -> None:
        self.written[index] = Outcome(index, 1, code, None, f"exit {code}", None, 1.0, 2.0)


@pytest.mark.parametrize("end", [ended("", None), NodeStatus(NodePhase.ENDED, cause=Cause.EXIT, exit_code=0)])
def test_an_outcome_that_was_not_there_before_the_node_ended_is_looked_for_again(end: NodeStatus) -> None:
    gang = Gang()
    assert isinstance(gang.poll(ABSENT, ABSENT), Observed), "what can't be seen is looked for, and not waited for"
    gang.pool.carry_out()  # it finds nothing
    gang.write(0, 0)
    running: GangStatus = [end, NodeStatus(NodePhase.RUNNING)]
    assert gang.poll(*running).unread == ""
    gang.pool.carry_out()
    seen = gang.poll(*running)
    assert isinstance(seen, Observed) and seen.ends[1] is None
    assert seen.ends[0] is not None and (seen.ends[0].exit_code, seen.ends[0].reason) == (0, "exit 0")


@pytest.mark.parametrize("is_on", [True, False])
def test_outcomes_of_nodes_that_an_earlier_controller_met_are_looked_for_only_where_there_is_a_bus(is_on: bool) -> None:
    gang, runs = Gang("tcp/127.0.0.1:7447" if is_on else None), NodeStatus(NodePhase.RUNNING)
    gang.presence.expect("job", 1, 2, met=[0, 1])
    seen = gang.poll(runs, runs)
    assert isinstance(seen, Observed) and [each is not None for each in seen.silences] == [is_on] * 2
    assert bool(gang.pool.calls) is is_on and gang.observer.has_hidden(("job", 1)) is is_on
    for node in range(2):
        gang.presence.came(("job", 1, node))
    gang.poll(runs, runs)
    assert not gang.observer.has_hidden(("job", 1))


@pytest.mark.parametrize("hidden", [ABSENT, NodeStatus(NodePhase.RUNNING, stale="slurmctld is away")])
def test_a_node_that_its_engine_can_t_see_is_looked_for_again_soon_also_without_a_bus(hidden: NodeStatus) -> None:
    gang = Gang(None)
    gang.poll(hidden, NodeStatus(NodePhase.RUNNING))
    assert gang.observer.has_hidden(("job", 1))
    gang.write(0, 0)
    gang.pool.carry_out()
    for _ in range(2):  # the first one takes what was read
        gang.poll(hidden, NodeStatus(NodePhase.RUNNING))
    assert not gang.observer.has_hidden(("job", 1)), "its outcome is known"


def test_a_node_that_ends_while_others_are_looked_for_is_not_taken_for_one_without_an_outcome() -> None:
    gang = Gang()
    gang.poll(ABSENT, ABSENT)
    body, future = gang.pool.calls.pop()
    found = body()  # by now it has found none
    gang.write(0, 0)
    future.set_result(found)
    running: GangStatus = [ended("", None), NodeStatus(NodePhase.RUNNING)]
    assert gang.poll(*running).unread == ""
    gang.pool.carry_out()
    seen = gang.poll(*running)
    assert isinstance(seen, Observed) and seen.ends[0] is not None and seen.ends[0].exit_code == 0


def test_a_node_that_ends_while_outcomes_are_read_again_after_an_error_is_looked_for_by_itself() -> None:
    gang = Gang()
    one: GangStatus = [ended("", None), NodeStatus(NodePhase.RUNNING)]
    assert gang.poll(*one).unread == ""
    _, failed = gang.pool.calls.pop()
    failed.set_exception(StoreUnavailable("away"))
    assert gang.poll(*one).unread == "away"
    gang.observer._errands._failing.hurry(("job", 1))
    gang.poll(*one)  # the call that is under way from now on reads node 0 alone
    gang.write(1, 0)
    both: GangStatus = [ended("", None), ended("", None)]
    assert gang.poll(*both).ends == [None, None]
    gang.pool.carry_out()
    gang.poll(*both)
    gang.pool.carry_out()
    first, second = gang.poll(*both).ends
    assert (first.exit_code, second.exit_code) == (137, 0)
