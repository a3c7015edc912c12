"""Log lines of all nodes and attempts come back once each, in the order of their times."""

from __future__ import annotations

import itertools
import tempfile
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shared_store.layout import Run
from shared_store.logs import LogFollower, LogLine, format_line, parse_line, timestamp

START = 1_800_000_000.0


@pytest.fixture
def run(tmp_path: Path) -> Run:
    return Run(tmp_path)


def append(run: Run, text: str | bytes, node: int = 0, attempt: int = 1, job: str = "job") -> None:
    path = run.log(job, attempt, node)
    path.parent.mkdir(parents=True, exist_ok=True)
    with open(path, "ab") as file:
        file.write(text if isinstance(text, bytes) else text.encode())


def line(second: float, text: str, rank: int | None = 0, stream: str = "o") -> str:
    return format_line(START + second, rank, stream, text)


def texts(lines: list[LogLine]) -> list[str]:
    return [line.text for line in lines]


@given(st.text(), st.one_of(st.none(), st.integers(0, 4000)), st.sampled_from("oe"))
def test_a_line_comes_back_as_it_was_written(text: str, rank: int | None, stream: str) -> None:
    written = format_line(START, rank, stream, text)
    assert written.count("\n") == 1
    plain = text.replace("\r", "").replace("\n", "\\n")
    assert parse_line(written[:-1], 2, 5) == LogLine(timestamp(START), 2, 5, rank, stream, plain)


def test_a_line_has_its_time_in_utc_with_microseconds_and_any_other_is_not_parsed() -> None:
    assert timestamp(0.25) == "1970-01-01T00:00:00.250000Z"
    assert format_line(0.25, 3, "e", "text") == "1970-01-01T00:00:00.250000Z 3 e text\n"
    assert format_line(0.25, None, "o", "text") == "1970-01-01T00:00:00.250000Z - o text\n"
    for text in ("", "text", "2026-01-01T00:00:00Z x o text", "2026-01-01T00:00:00Z 0 z text"):
        assert parse_line(text, 1, 0) is None


def test_nodes_and_attempts_are_merged_by_time(run: Run) -> None:
    append(run, line(1, "a") + line(4, "d"), node=0)
    append(run, line(2, "b", 1) + line(3, "c", 1), node=1)
    append(run, line(5, "f") + line(5.5, "g"), node=0, attempt=2)
    append(run, line(4.5, "e", 10), node=10, attempt=2)
    lines = LogFollower(run, "job").poll()
    assert texts(lines) == ["a", "b", "c", "d", "e", "f", "g"]
    assert [(line.attempt, line.node, line.rank) for line in lines[3:5]] == [(1, 0, 0), (2, 10, 10)]


def test_the_tenth_attempt_comes_after_the_second_and_foreign_lines_hide_no_others(run: Run) -> None:
    for attempt in (10, 2, 9):
        append(run, line(1, str(attempt)), attempt=attempt)
    assert texts(LogFollower(run, "job").poll()) == ["2", "9", "10"]
    invalid = line(2, "b").encode()[:-1] + b"\xff\n"
    append(run, line(1, "a").encode() + b"\xff\xfe foreign\n" + invalid + line(3, "c").encode())
    assert texts(LogFollower(run, "job").poll()) == ["a", "b\N{REPLACEMENT CHARACTER}", "c", "2", "9", "10"]


def test_other_jobs_and_other_files_are_not_read(run: Run) -> None:
    assert LogFollower(run, "job").poll() == LogFollower(run, "job", attempt=3).poll() == []
    append(run, line(1, "ours"))
    append(run, line(1, "theirs"), job="other")
    (run.logs("job", 1) / "node-0.log.gz").write_text(line(1, "no"))
    (run.path / "logs" / "job" / "notes").mkdir()
    assert texts(LogFollower(run, "job").poll()) == ["ours"]


def test_a_follower_reads_each_line_once_it_is_whole_and_another_goes_on_from_its_offsets(run: Run) -> None:
    follower, whole = LogFollower(run, "job"), line(1, "grüße").encode()
    append(run, line(0, "before").encode() + whole[:-3])  # cut inside a character
    assert texts(follower.poll()) == ["before"] and follower.poll() == []
    append(run, whole[-3:])
    assert texts(follower.poll()) == ["grüße"]
    append(run, line(2, "b"))
    append(run, line(1.5, "late"), node=1)
    assert texts(follower.poll()) == ["late", "b"]
    append(run, line(3, "c"))
    append(run, line(4, "d"), attempt=2)
    assert texts(LogFollower(run, "job", offsets=dict(follower.offsets)).poll()) == ["c", "d"]


def test_node_rank_and_attempt_select(run: Run) -> None:
    append(run, line(1, "0/0", 0) + line(2, "0/1", 1) + line(3, "supervisor", None))
    append(run, line(1, "1/2", 2), node=1)
    append(run, line(9, "second", 0), attempt=2)
    assert texts(LogFollower(run, "job", node=1).poll()) == ["1/2"]
    assert texts(LogFollower(run, "job", rank=1).poll()) == ["0/1"]
    assert texts(LogFollower(run, "job", attempt=2).poll()) == ["second"]
    assert texts(LogFollower(run, "job", node=0, rank=0).poll()) == ["0/0", "second"]


def test_draining_reads_to_the_end_of_a_log_longer_than_one_poll(run: Run) -> None:
    append(run, "".join(line(i * 1e-3, f"{i:05d} {'x' * 2000}") for i in range(1200)))
    assert [text[:5] for text in texts(list(LogFollower(run, "job").drain()))] == [f"{i:05d}" for i in range(1200)]


def test_draining_one_rank_finds_its_lines_behind_any_amount_of_another_rank_s(run: Run) -> None:
    append(run, line(1, "first", 1) + line(2, "y" * 1000) * 3000 + line(3, "last", 1))
    assert texts(list(LogFollower(run, "job", rank=1).drain())) == ["first", "last"]


@settings(max_examples=40)
@given(
    st.lists(st.tuples(st.integers(0, 2), st.text(max_size=20)), max_size=8), st.lists(st.integers(1, 60), min_size=1)
)
def test_however_the_writes_are_cut_every_line_is_read_once_and_in_order(
    written: list[tuple[int, str]], cuts: list[int]
) -> None:
    with tempfile.TemporaryDirectory() as directory:
        run = Run(Path(directory))
        follower, pending = LogFollower(run, "job"), {node: b"" for node in range(3)}
        for second, (node, text) in enumerate(written):
            pending[node] += line(second, text, node).encode()
        read, sizes = list[LogLine](), itertools.cycle(cuts)
        while any(pending.values()):
            for node in pending:
                cut = next(sizes)
                append(run, pending[node][:cut], node)
                pending[node] = pending[node][cut:]
                read += follower.poll()
        for node in range(3):
            expected = [text.replace("\r", "").replace("\n", "\\n") for owner, text in written if owner == node]
            assert [line.text for line in read if line.node == node] == expected
