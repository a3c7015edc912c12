"""The newest part of a followed log, in memory: whatever happens to pushes, a reader gets each line once, and memory is bounded."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from orchestrator.control import log_tail
from orchestrator.control.log_tail import MOST, JobLogs
from shared_store.contract.node import LEAST_LOG_LIMIT
from shared_store.volume.layout import Run
from shared_store.volume.log_files import LogWriter
from shared_store.volume.log_view import LogView
from shared_store.volume.logs import REPLACED, format_line

LOG = (1, 0)


class Followed:
    """A job of one node that is followed: its log, the messages of its node, and one reader."""

    def __init__(self, directory: Path, limit: int = 1 << 30) -> None:
        directory.mkdir()
        self.run = Run(directory)
        self.path = self.run.log("job", *LOG)
        self.writer = LogWriter(self.path, limit)
        self.logs, self.view = JobLogs(self.run, "job"), LogView.of(self.run, "job")
        self.seen: list[str] = []
        self.hidden = b""
        """What a network volume does not show to the controller yet."""
        self.late: list[tuple[int, bytes]] = []
        """Pushes that have not come."""
        self.written = 0
        self.logs.note(1, 1)
        self.logs.poll()
        self.view.poll()

    def write(self, *texts: str, push: bool = True, visible: bool = True) -> None:
        data = "".join(format_line(1_800_000_000.0 + self.written, 0, "o", text) for text in texts).encode()
        self.written += len(texts)
        start = self.end
        self.hidden += data
        if visible:
            self.show()
        self.late.append((start, data))
        if push:
            self.deliver()

    @property
    def end(self) -> int:
        return (self.writer.end() or 0) + len(self.hidden)

    def show(self) -> None:
        self.writer.append(self.hidden)
        self.hidden = b""

    def deliver(self, index: int = -1) -> None:
        self.logs.push(LOG, *self.late.pop(index))

    def state(self, *, is_whole: bool = False) -> bool:
        return self.logs.state(LOG, self.end, is_whole)

    def read(self, *, memory_alone: bool = False) -> list[str]:
        """The texts that are new to the reader; it reads files only where it must, or where ``memory_alone`` fails the test."""
        is_behind = True
        while is_behind:
            found = self.view.poll_memory(self.logs, 1 << 12)
            assert found is not None or not memory_alone
            lines = self.view.poll() if found is None else found
            self.seen += [line.text for line in lines]
            is_behind = bool(lines) or self.view.behind
        return self.seen


@pytest.fixture
def job(tmp_path: Path) -> Followed:
    return Followed(tmp_path / "run")


def test_a_push_that_comes_before_another_waits_for_it_and_doubles_change_nothing(job: Followed) -> None:
    for text in "abc":
        job.write(text, push=False)
    double = job.late[1]
    job.deliver(2)
    job.deliver(1)
    assert job.read() == [] and not job.logs.delivers()
    job.deliver(0)
    job.logs.push(LOG, *double)
    assert job.read(memory_alone=True) == ["a", "b", "c"]


def test_a_log_that_was_truncated_is_read_from_its_new_beginning(job: Followed) -> None:
    job.write("one", "two")
    job.read()
    job.path.write_bytes(b"")
    job.write("three", push=False)
    assert job.state()
    job.logs.poll()
    assert job.read() == ["one", "two", REPLACED, "three"]


def test_a_node_that_has_ended_needs_no_look_for_ever(job: Followed, monkeypatch: pytest.MonkeyPatch) -> None:
    job.write("last")
    job.state(is_whole=True)
    monkeypatch.setattr(log_tail, "FRESH", 0.0)
    assert job.logs.delivers()


def test_memory_is_bounded_and_a_slow_reader_goes_on_in_the_files(job: Followed) -> None:
    text = "x" * 10_000
    for number in range(300):
        job.write(f"{number} {text}")
    kept = job.logs._tails[LOG]
    assert len(kept.data) <= MOST * 5 / 4
    for number in range(300, 400):
        job.write(f"{number} {text}", push=number % 2 == 0)
    assert sum(map(len, kept.early.values())) <= MOST
    assert job.state()
    job.logs.poll()
    assert [int(each.split()[0]) for each in job.read()] == list(range(400))


def test_a_reader_that_comes_too_late_hears_what_was_left_out(tmp_path: Path) -> None:
    job = Followed(tmp_path / "run", LEAST_LOG_LIMIT)
    for number in range(1500):
        job.write(f"{number} " + "x" * 2000, push=number % 100 != 0)
    while job.state():
        job.logs.poll()
    texts = job.read()
    assert texts[0].startswith("0 ") and texts[-1].startswith("1499 ")
    assert sum("left out: the log reached its limit" in text for text in texts) == 1


def test_pushes_that_come_too_early_are_few_whatever_a_node_sends(job: Followed) -> None:
    for position in range(1, 4000):
        job.logs.push(LOG, 2 * position, b"")
    assert len(job.logs._tails[LOG].early) <= log_tail._EARLY
    for position in range(1, 4000):
        job.logs.push(LOG, position, b"x")
        assert len(job.logs._tails[LOG].early) <= log_tail._EARLY


@pytest.fixture
def cached_size(job: Followed, monkeypatch: pytest.MonkeyPatch) -> None:
    """The volume is NFS: it has cached the log's size of now, and only who opens the file learns the true one."""
    genuine, size = os.stat, job.path.stat().st_size

    def stat(path: Any, *given: Any, **named: Any) -> os.stat_result:
        found = genuine(path, *given, **named)
        is_log = isinstance(path, Path) and path == job.path
        return os.stat_result((*found[:6], size, *found[7:])) if is_log else found

    monkeypatch.setattr(os, "stat", stat)


@pytest.mark.parametrize("reader", ["the hub", "the last look of a follower"])
def test_a_last_burst_that_was_not_pushed_is_read_though_the_volume_s_cached_size_is_old(
    job: Followed, cached_size: None, reader: str
) -> None:
    job.write("pushed")
    assert job.read(memory_alone=True) == ["pushed"]
    job.write("burst", push=False)
    if reader == "the hub":
        assert job.logs.poll() and job.read(memory_alone=True) == ["pushed", "burst"]
    else:
        assert [line.text for line in job.view.drain()] == ["burst"]


def test_the_last_look_gives_no_line_twice_where_the_volume_shows_the_log_late_or_in_another_file(
    tmp_path: Path,
) -> None:
    job = Followed(tmp_path / "run", LEAST_LOG_LIMIT)
    job.write("in the first file", push=False)
    job.logs.poll()
    assert [line.text for line in job.view.poll()] == ["in the first file"]
    for number in range(300):
        job.write(f"{number} " + "x" * 2000)
        job.read(memory_alone=True)
    assert len(list(job.path.parent.iterdir())) > 1, "the log has gone on in another file"
    job.write("late", visible=False)
    assert job.read(memory_alone=True)[-1] == "late"
    assert list(job.view.drain()) == []
    job.show()
    job.write("last", push=False)
    assert [line.text for line in job.view.drain()] == ["last"]


def test_a_reader_visits_the_logs_that_have_changed_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    logs, nodes = JobLogs(Run(tmp_path), "job"), 1000
    view = LogView.of(logs.run, "job")
    logs.note(1, nodes)
    logs.poll()
    view.poll()
    data = format_line(1_800_000_000.0, 0, "o", "text").encode()
    for node in range(nodes):
        logs.push((1, node), 0, data)
    lines = view.poll_memory(logs, 1 << 14)
    assert lines is not None and len(lines) == nodes == len(view.offsets)
    visited = list[tuple[int, int]]()
    genuine = logs.read
    monkeypatch.setattr(logs, "read", lambda log, *given: (visited.append(log), genuine(log, *given))[1])
    assert view.poll_memory(logs, 1 << 14) == [] and not visited
    logs.push((1, 7), len(data), data)
    lines = view.poll_memory(logs, 1 << 14)
    assert lines is not None and [line.node for line in lines] == [7] and set(visited) == {(1, 7)}
    logs.push((1, 8), len(data), data * 1000)
    lines = view.poll_memory(logs, len(data) * 10)
    assert lines is not None and len(lines) == 10 and view.behind
    while view.behind:
        lines += view.poll_memory(logs, len(data) * 10) or []
    assert len(lines) == 1000 and set(visited) == {(1, 7), (1, 8)}


ACTIONS = st.one_of(
    st.tuples(st.just("write"), st.booleans(), st.booleans()),
    st.tuples(st.just("deliver"), st.integers(0, 5), st.just(0)),
    st.tuples(
        st.sampled_from(["lose", "double", "show", "state", "look", "read", "unknown"]), st.integers(0, 5), st.just(0)
    ),
)


@settings(max_examples=150, deadline=None)
@given(st.lists(ACTIONS, max_size=40))
def test_whatever_happens_to_pushes_and_files_every_line_is_read_once_and_in_order(
    actions: list[tuple[str, int, int]],
) -> None:
    with tempfile.TemporaryDirectory() as directory:
        job = Followed(Path(directory) / "run")
        for what, first, second in actions:
            if what == "write":
                job.write(f"line {job.written}", push=bool(first), visible=bool(second))
            elif what == "show":
                job.show()
            elif what == "state":
                job.state()
            elif what == "unknown":
                job.logs.state(LOG, None, False)
            elif what == "look":
                job.logs.poll()
            elif what == "read":
                job.read()
            elif job.late:
                index = first % len(job.late)
                if what == "double":
                    job.logs.push(LOG, *job.late[index])
                else:
                    job.late.pop(index) if what == "lose" else job.deliver(index)
        job.show()
        job.state()
        job.logs.poll()
        assert job.read() == [f"line {number}" for number in range(job.written)]
