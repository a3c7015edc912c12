"""Followers of one controller: woken by what nodes push, by commits and by what a shared look at the files finds."""

from __future__ import annotations

import asyncio
import errno
import threading
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from orchestrator.api.native.log_stream import followed
from orchestrator.control import log_hub, log_tail
from orchestrator.control.log_hub import LogHub, Waker
from orchestrator.control.store_calls import StoreCalls
from orchestrator.domain.job import Status
from orchestrator.persistence.batch_models import Attempt, Job, Node
from orchestrator.persistence.session import Database
from shared_store.volume import log_files, log_view
from shared_store.volume.layout import Run
from shared_store.volume.log_files import Chunk, LogWriter, read_log
from shared_store.volume.log_view import LogView
from shared_store.volume.logs import format_line
from tests.support.orchestrator import rows
from tests.support.waiting import wait_for


class World:
    """A controller's hub with a real database and a real store; the test is the nodes and the bus."""

    def __init__(self, directory: Path) -> None:
        self.database = Database.at(directory)
        self.requested = Counter[tuple[str, int]]()
        self.bus = SimpleNamespace(ask_for_logs=lambda job, attempt: self.requested.update([(job, attempt)]))
        self.problem: str | None = None
        self.calls = StoreCalls(directory, lambda: self.problem)
        self.hub = LogHub(self.database, self.bus, self.calls)  # type: ignore[arg-type]
        self.database.committed = lambda jobs: self.hub.changed(job.id for job in jobs)
        self.directory, self.writers = directory, dict[tuple[int, int], LogWriter]()
        self.received, self.threads = list[list[str]](), list[threading.Thread]()
        self.closing = threading.Event()
        with self.database.session() as session:
            session.add(rows.job("job", status=Status.RUNNING))
        self.begin(1)

    @property
    def run(self) -> Run:
        return Run(self.directory / "run")

    def begin(self, number: int) -> None:
        """Open an attempt of two nodes, whose logs are there."""
        with self.database.session() as session:
            job = session.get_one(Job, "job")
            nodes = [Node(index=index, host="localhost") for index in range(2)]
            job.attempts.append(Attempt(number=number, epoch=number, nodes=nodes))
        self.run.path.mkdir(exist_ok=True)
        for node in range(2):
            self.writers[number, node] = LogWriter(self.run.log("job", number, node))

    def end(self, number: int, status: Status | None = None) -> None:
        """Close an attempt, and end the job with ``status``."""
        with self.database.session() as session:
            job = session.get_one(Job, "job")
            job.attempts[number - 1].stopped_at = 1
            job.status = status or job.status

    def write(self, text: str, log: tuple[int, int] = (1, 0), *, push: bool = True) -> None:
        writer = self.writers[log]
        data = format_line(1_800_000_000.0 + (writer.end() or 0), 0, "o", text).encode()
        writer.append(data)
        if push:
            self.bus.pushed(("job", *log), (writer.end() or 0) - len(data), data)

    def state(self, attempt: int = 1, *, end: int | None = None, is_whole: bool = False) -> None:
        for (number, node), writer in self.writers.items():
            if number == attempt:
                self.bus.stated(("job", number, node), writer.end() if end is None else end, is_whole)

    def follow(self) -> list[str]:
        """The pieces that a new follower gets, which grow; it has begun."""
        pieces: list[str] = []
        view = LogView.of(self.run, "job")

        async def read() -> None:
            async for piece in followed(view, self.hub, self.calls, self.closing):
                pieces.append(piece)

        self.threads.append(threading.Thread(target=lambda: asyncio.run(read()), daemon=True))
        self.threads[-1].start()
        return pieces

    def settle(self) -> None:
        """Until the hub takes what nodes tell, which they do then."""
        wait_for(lambda: self.hub._followed and self.hub._followed["job"].logs._has_polled, what="the first look")
        self.state(max(number for number, _ in self.writers))
        wait_for(self.is_quiet, what="that nobody looks at files")

    def is_quiet(self) -> bool:
        """Whether all nodes push, and no look at the files is under way."""
        job = self.hub._followed["job"]
        return job.logs.delivers() and not job.is_polled

    def close(self) -> None:
        self.closing.set()
        self.hub.close()
        for thread in self.threads:
            thread.join(60)
        assert not any(thread.is_alive() for thread in self.threads)
        self.database.close()


@pytest.fixture
def world(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[World]:
    monkeypatch.setattr(log_tail, "FRESH", 3600.0)  # what nodes tell counts until the test says otherwise
    world = World(tmp_path)
    yield world
    world.close()


def has(pieces: list[str], *texts: str) -> bool:
    whole = "".join(pieces)
    return all(whole.count(f'"text": "{text}"') == 1 for text in texts)


@pytest.fixture
def polls(monkeypatch: pytest.MonkeyPatch) -> Counter[str]:
    """How often the hub and the followers have read a log file."""
    found: Counter[str] = Counter()
    genuine = read_log

    def counted(name: str) -> Callable[..., Chunk]:
        def read(*supplied: Any) -> Chunk:
            found[name] += 1
            return genuine(*supplied)

        return read

    monkeypatch.setattr(log_tail, "read_log", counted("hub"))
    monkeypatch.setattr(log_files, "read_log", counted("followers"))
    return found


def test_a_lost_push_costs_one_look_for_all_followers(world: World, polls: Counter[str]) -> None:
    everyone = [world.follow() for _ in range(20)]
    world.settle()
    world.write("first")
    wait_for(lambda: all(has(each, "first") for each in everyone))
    polls.clear()
    world.write("lost", push=False)
    world.state()
    wait_for(lambda: all(has(each, "lost") for each in everyone))
    assert polls["hub"] <= 2 and not polls["followers"]


def test_a_supervisor_that_knows_no_pushes_any_more_is_read_and_asked_again(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(log_hub, "_ASK", 0.05)
    monkeypatch.setattr(log_hub, "_ASK_SELDOM", 0.1)
    pieces = world.follow()
    world.settle()
    requested = world.requested["job", 1]
    world.bus.stated(("job", 1, 0), None, False)
    world.write("of the successor", push=False)
    wait_for(lambda: has(pieces, "of the successor") and world.requested["job", 1] > requested)


def test_followers_end_with_the_job_and_have_its_last_line_though_its_push_was_lost(world: World) -> None:
    everyone = [world.follow() for _ in range(5)]
    world.settle()
    world.write("seen")
    wait_for(lambda: all(has(each, "seen") for each in everyone))
    world.write("the very last", push=False)
    world.end(1, Status.SUCCEEDED)
    for thread in world.threads:
        thread.join(60)
        assert not thread.is_alive()
    assert all(has(each, "seen", "the very last") for each in everyone)
    assert not world.hub._followed, "nothing is kept for nobody"


def test_followers_end_though_no_commit_reported_the_end(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(log_hub, "_ROWS", 0.0)
    pieces = world.follow()
    world.settle()
    world.write("seen")
    wait_for(lambda: has(pieces, "seen"))
    world.database.committed = None
    world.end(1, Status.FAILED)
    world.threads[-1].join(60)
    assert not world.threads[-1].is_alive()


def test_the_follower_of_a_job_that_is_over_or_gone_ends(world: World) -> None:
    world.write("all", push=False)
    with world.database.session() as session:
        session.delete(session.get_one(Job, "job"))
    pieces = world.follow()
    world.threads[-1].join(60)
    assert not world.threads[-1].is_alive() and has(pieces, "all")


def test_a_new_attempt_is_taken_up_and_asked_and_the_end_of_the_former_is_not_lost(world: World) -> None:
    pieces = world.follow()
    world.settle()
    world.write("first attempt")
    wait_for(lambda: has(pieces, "first attempt"))
    world.write("its end", push=False)
    world.end(1)
    world.begin(2)
    world.write("second attempt", (2, 1), push=False)
    wait_for(lambda: has(pieces, "first attempt", "its end", "second attempt") and world.requested["job", 2])
    world.settle()
    world.write("pushed", (2, 0))
    wait_for(lambda: has(pieces, "pushed"))


def test_while_the_store_is_away_lines_come_from_memory_and_nothing_is_lost(world: World) -> None:
    pieces = world.follow()
    world.settle()
    world.write("before")
    wait_for(lambda: has(pieces, "before"))
    world.problem = "there is no store"
    (world.directory / "run").rename(world.directory / "unmounted")
    world.write("pushed meanwhile")
    wait_for(lambda: has(pieces, "pushed meanwhile"))
    world.write("lost meanwhile", push=False)
    world.state()
    (world.directory / "unmounted").rename(world.directory / "run")
    world.problem = None
    wait_for(lambda: has(pieces, "before", "pushed meanwhile", "lost meanwhile"))


def test_a_log_that_can_t_be_read_ends_its_stream_with_the_reason(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: object) -> list[int]:
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr(log_view, "attempts_with_logs", broken)
    pieces = world.follow()
    world.threads[-1].join(60)
    assert "the log can't be read now: [Errno 5] Input/output error" in "".join(pieces)


def test_a_follower_that_takes_nothing_holds_no_other_up_and_keeps_little(world: World) -> None:
    waker = Waker()
    with world.hub.follow(world.run, "job", waker) as logs:  # it never reads
        pieces = world.follow()
        world.settle()
        for number in range(400):
            world.write(f"{number} " + "x" * 5000)
        world.state()
        wait_for(lambda: "".join(pieces).count('"time"') == 400)
        kept = sum(len(tail.data) + sum(map(len, tail.early.values())) for tail in logs._tails.values())
        assert kept <= 2 * log_tail.MOST


def test_all_followed_logs_share_a_bounded_memory(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    bound = 1 << 20
    monkeypatch.setattr(log_hub, "_MEMORY", bound)
    with world.hub.follow(world.run, "job", Waker()) as logs:
        world.settle()
        for node in range(40):
            for position in range(0, 1 << 18, 1 << 14):
                world.bus.pushed(("job", 1, node), position, b"x" * (1 << 14))
                world.bus.pushed(("job", 1, node), position + (1 << 30), b"x" * (1 << 14))

        def kept() -> int:
            return sum(len(tail.data) + sum(map(len, tail.early.values())) for tail in logs._tails.values())

        wait_for(lambda: len(logs) == 40 and kept() < bound, what="that older parts are dropped")


def test_looks_become_rare_while_they_find_nothing_and_frequent_again_with_a_change_or_a_push(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = 1000.0
    monkeypatch.setattr(log_hub, "machine", SimpleNamespace(monotonic=lambda: clock))
    job, polls = log_hub._Followed(world.run, "job"), 0
    genuine = job.logs.poll

    def poll() -> bool:
        nonlocal polls
        polls += 1
        return genuine()

    monkeypatch.setattr(job.logs, "poll", poll)

    def looks_in(seconds: float) -> int:
        nonlocal clock
        before = polls
        for _ in range(round(seconds / 0.05)):
            clock += 0.05001
            world.hub._round([job])
            wait_for(lambda: not job.is_polled)
        return polls - before

    assert looks_in(2.0) >= 20, "after a tenth of the silence"
    assert 10 <= looks_in(8.0) <= 20
    assert looks_in(20.0) <= 22, "about one a second"
    world.write("new", push=False)
    assert looks_in(2.0) >= 5, "the next look found it, and others follow soon"
    looks_in(9.0)
    assert looks_in(20.0) <= 22
    world.hub._followed["job"] = job
    world.write("pushed")
    assert looks_in(0.1) >= 1
