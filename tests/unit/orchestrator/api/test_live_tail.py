"""StartLiveTail follows while its answer is open, and leaves nothing behind, whenever it is given up."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from orchestrator.api.logs import live_tail
from orchestrator.api.logs.live_tail import LiveTail
from orchestrator.api.logs.streams import Stream
from orchestrator.control.log_hub import LogHub
from orchestrator.control.store_calls import StoreCalls
from orchestrator.domain.job import Status
from orchestrator.persistence.session import Database
from orchestrator.services.permissions import CONTROLLER
from shared_store.volume.layout import Run
from shared_store.volume.log_files import LogWriter
from shared_store.volume.logs import format_line
from tests.support.orchestrator import rows
from tests.support.waiting import wait_for


class World:
    """A hub and the running jobs that a session asks for; the database names them, their nodes are the test."""

    def __init__(self, directory: Path) -> None:
        self.database, self.directory = Database.at(directory), directory
        bus: Any = SimpleNamespace(ask_for_logs=lambda *_: None)
        self.calls = StoreCalls(directory)
        self.hub = LogHub(self.database, bus, self.calls)
        access = SimpleNamespace(followed=self.calls, store=SimpleNamespace())
        self.controller: Any = SimpleNamespace(database=self.database, logs=self.hub, access=access)
        self.streams = list[Stream]()
        self.writers = dict[str, LogWriter]()

    def begin(self, job: str) -> None:
        run = Run(self.directory / "run")
        run.path.mkdir(exist_ok=True)
        with self.database.session() as session:
            session.add(rows.job(job, status=Status.RUNNING))
        self.writers[job] = LogWriter(run.log(job, 1, 0))
        self.streams.append(Stream(f"{job}/1/0", "group", run.log(job, 1, 0), 1, True, run, job, 1, 0))

    def write(self, job: str, text: str) -> None:
        self.writers[job].append(format_line(1_800_000_000.0, 0, "o", text).encode())

    def tail(self) -> LiveTail:
        return LiveTail(self.controller, CONTROLLER, ["group"], lambda _: True, lambda _: True)

    @property
    def followers(self) -> int:
        return len(self.hub._watching) + len(self.hub._followed)


@pytest.fixture
def world(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[World]:
    world = World(tmp_path)
    monkeypatch.setattr(live_tail, "newest_streams", lambda *_, **__: list(world.streams))
    world.begin("job")
    yield world
    world.hub.close()
    world.database.close()


def test_a_session_whose_answer_is_given_up_before_it_begins_follows_nothing(world: World) -> None:
    world.tail()
    assert world.followers == 0
    with world.tail():
        assert world.followers == 2
    assert world.followers == 0


def test_a_session_has_the_lines_from_its_making_on_and_jobs_that_begin_meanwhile(world: World) -> None:
    world.write("job", "before")
    tail = world.tail()
    world.write("job", "between")
    world.begin("new")
    world.write("new", "of a new job")
    with tail:
        texts = list[str]()

        def has_all() -> bool:
            found = tail.poll_memory()
            texts.extend(event.text for event in (tail.poll() if found is None else found))
            return sorted(texts) == ["between", "of a new job"]

        wait_for(has_all)


def test_a_session_that_is_closed_while_it_takes_up_a_job_does_not_follow_it(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    is_asking, is_closed = threading.Event(), threading.Event()
    tail = world.tail()

    def slow(*_: Any, **__: Any) -> list[Stream]:
        is_asking.set()
        assert is_closed.wait(60)
        return world.streams

    with tail:
        world.begin("new")
        monkeypatch.setattr(live_tail, "newest_streams", slow)
        tail.wake()
        thread = threading.Thread(target=tail.poll, daemon=True)
        thread.start()
        assert is_asking.wait(60)
    is_closed.set()
    thread.join(60)
    assert not thread.is_alive() and world.followers == 0
