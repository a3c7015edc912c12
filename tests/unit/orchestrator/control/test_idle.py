"""What a pass of the controller's loop costs: nothing where nothing has changed, else only the jobs that have."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any, TypeVar

import pytest
from sqlalchemy import Engine, event

from orchestrator.control import admission
from orchestrator.control.attempts import Attempts
from orchestrator.control.run_store import RunStore
from orchestrator.domain.hosts import Host, Hosts
from orchestrator.domain.job import Status
from orchestrator.engines.testing.fake import FakeEngine
from tests.support.orchestrator.fake_controller import FakeController, properties

T = TypeVar("T")
GANGS = 20


class CountedStore(RunStore):
    """Its calls are listed."""

    calls: list[str]

    def _call(self, what: str, body: Callable[[], T]) -> T:
        self.calls.append(what)
        return super()._call(what, body)


class Costs:
    """Statements, calls of the store, and files that a pass opens or lists."""

    def __init__(self, store: list[str]) -> None:
        self.statements: list[str] = []
        self.files: list[str] = []
        self.store = store
        self._thread: int | None = None
        sys.addaudithook(self._audit)  # for good: it does nothing unless a pass is watched

    def note(self, _connection: Any, _cursor: Any, statement: str, *_: Any) -> None:
        self.statements.append(statement)

    def watched(self, body: Callable[[], None]) -> None:
        """Carry out ``body`` and count."""
        self.statements.clear()
        self.files.clear()
        self.store.clear()
        self._thread = threading.get_ident()
        try:
            body()
        finally:
            self._thread = None

    def _audit(self, what: str, arguments: Any) -> None:
        if self._thread == threading.get_ident() and what in ("open", "os.listdir", "os.scandir"):
            self.files.append(f"{what} {arguments[0]}")


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[tuple[FakeController[FakeEngine], Costs]]:
    with ExitStack() as stack:
        CountedStore.calls = []
        engine = FakeEngine(capacity=Hosts([Host("fake/host", float(GANGS + 2), (), 1 << 20)]))
        made, costs = FakeController(tmp_path, engine, stack, CountedStore), Costs(CountedStore.calls)
        event.listen(Engine, "before_cursor_execute", costs.note)
        stack.callback(event.remove, Engine, "before_cursor_execute", costs.note)
        made.submit(*(f"job-{number}" for number in range(GANGS - 1)), node_properties=properties(1))
        made.submit("pair", node_properties=properties(1, nodes=2))
        made.ticks(lambda: made.database.counts.by_status() == {Status.RUNNING: GANGS})
        made.ticks(lambda: min(made.controller.work_queue._active.values()) > time.monotonic())
        yield made, costs


def test_a_pass_in_which_nothing_changed_reads_and_writes_nothing(
    bench: tuple[FakeController[FakeEngine], Costs],
) -> None:
    controller, costs = bench
    polls = controller.engine.polls

    def passes() -> None:
        for _ in range(10):
            controller.controller.tick()
        controller.ticks(lambda: controller.engine.polls > polls + 2)  # the engine is looked at all the same

    costs.watched(passes)
    assert (costs.statements, costs.store, costs.files) == ([], [], [])


def test_a_job_that_waits_costs_nothing_between_two_scheduling_passes(
    bench: tuple[FakeController[FakeEngine], Costs], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(admission, "_PASS_INTERVAL", 3600.0)
    controller, costs = bench
    controller.submit("large", node_properties=properties(4))
    passed = controller.controller.admission._passed
    controller.ticks(lambda: controller.controller.admission._passed[0] > passed[0])
    costs.watched(controller.controller.tick)
    assert (costs.statements, costs.store, costs.files) == ([], [], [])


def test_a_gang_that_ends_costs_looks_at_no_other(
    bench: tuple[FakeController[FakeEngine], Costs], monkeypatch: pytest.MonkeyPatch
) -> None:
    controller, costs = bench
    advance, polled = Attempts.advance, set[str]()

    def noted(self: Attempts, session: Any, job: Any, attempt: Any) -> Any:
        polled.add(job.id)
        return advance(self, session, job, attempt)

    monkeypatch.setattr(Attempts, "advance", noted)

    def passes() -> None:
        controller.engine.cluster.end("job-3/1/1", 0, 0)
        controller.ticks(lambda: controller.database.counts.by_status().get(Status.SUCCEEDED) == 1)

    costs.watched(passes)
    assert polled == {"job-3"}
    assert not [each for each in costs.statements if "SELECT" in each and "IN (?, ?" in each]
    assert costs.files == []


def test_an_engine_is_asked_for_all_gangs_at_once(bench: tuple[FakeController[FakeEngine], Costs]) -> None:
    controller, _ = bench
    requested, observe = list[int](), controller.engine.observe

    def observed(handles: Any) -> Any:
        requested.append(len(handles))
        return observe(handles)

    controller.engine.observe = observed  # type: ignore[method-assign]
    controller.ticks(lambda: len(requested) >= 3)
    assert set(requested) == {GANGS}
