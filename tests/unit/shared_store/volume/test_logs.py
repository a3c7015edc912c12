"""Log lines of all nodes and attempts come once each, in the order of their times; windows from any place."""

from __future__ import annotations

import itertools
import random
import shutil
import tempfile
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shared_store.contract.node import LEAST_LOG_LIMIT
from shared_store.volume.layout import Run
from shared_store.volume.log_files import Chunk, LogWriter, read_log
from shared_store.volume.log_view import Chosen, LogView
from shared_store.volume.log_windows import first_error, lines_after, lines_before, search
from shared_store.volume.logs import LogLine, format_line, parse_line, timestamp

START = 1_800_000_000.0


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
    lines = LogView.of(run, "job").poll()
    assert texts(lines) == ["a", "b", "c", "d", "e", "f", "g"]
    assert [(line.attempt, line.node, line.rank) for line in lines[3:5]] == [(1, 0, 0), (2, 10, 10)]


def test_the_tenth_attempt_comes_after_the_second_and_foreign_lines_hide_no_others(run: Run) -> None:
    for attempt in (10, 2, 9):
        append(run, line(1, str(attempt)), attempt=attempt)
    assert texts(LogView.of(run, "job").poll()) == ["2", "9", "10"]
    invalid = line(2, "b").encode()[:-1] + b"\xff\n"
    append(run, line(1, "a").encode() + b"\xff\xfe foreign\n" + invalid + line(3, "c").encode())
    assert texts(LogView.of(run, "job").poll()) == ["a", "b\N{REPLACEMENT CHARACTER}", "c", "2", "9", "10"]


def test_other_jobs_and_other_files_are_not_read(run: Run) -> None:
    assert LogView.of(run, "job").poll() == LogView.of(run, "job", attempt=3).poll() == []
    append(run, line(1, "ours"))
    append(run, line(1, "theirs"), job="other")
    (run.logs("job", 1) / "node-0.log.gz").write_text(line(1, "no"))
    (run.path / "logs" / "job" / "notes").mkdir()
    assert texts(LogView.of(run, "job").poll()) == ["ours"]


def test_node_rank_and_attempt_select(run: Run) -> None:
    append(run, line(1, "0/0", 0) + line(2, "0/1", 1) + line(3, "supervisor", None))
    append(run, line(1, "1/2", 2), node=1)
    append(run, line(9, "second", 0), attempt=2)
    assert texts(LogView.of(run, "job", node=1).poll()) == ["1/2"]
    assert texts(LogView.of(run, "job", rank=1).poll()) == ["0/1"]
    assert texts(LogView.of(run, "job", attempt=2).poll()) == ["second"]
    assert texts(LogView.of(run, "job", node=0, rank=0).poll()) == ["0/0", "second"]


def test_draining_one_rank_finds_its_lines_behind_any_amount_of_another_rank_s(run: Run) -> None:
    append(run, line(1, "first", 1) + line(2, "y" * 1000) * 3000 + line(3, "last", 1))
    assert texts(list(LogView.of(run, "job", rank=1).drain())) == ["first", "last"]


@settings(max_examples=40)
@given(
    st.lists(st.tuples(st.integers(0, 2), st.text(max_size=20)), max_size=8), st.lists(st.integers(1, 60), min_size=1)
)
def test_however_the_writes_are_cut_every_line_is_read_once_and_in_order(
    written: list[tuple[int, str]], cuts: list[int]
) -> None:
    with tempfile.TemporaryDirectory() as directory:
        run = Run(Path(directory))
        follower, pending = LogView.of(run, "job"), {node: b"" for node in range(3)}
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


JOB = "job"


def write(run: Run, attempt: int, node: int, lines: list[tuple[float, int | None, str]], limit: int = 1 << 30) -> None:
    writer = LogWriter(run.log(JOB, attempt, node), limit)
    for seconds, rank, text in lines:
        writer.append(format_line(seconds, rank, "o", text).encode())
    writer.close()


@pytest.fixture(scope="module")
def kept(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Two attempts on three nodes, whose lines come at random times; each node has two ranks."""
    run, chance = Run(tmp_path_factory.mktemp("kept")), random.Random(1)
    for attempt in (1, 2):
        times = sorted(attempt * 10_000 + i / 10 for i in chance.sample(range(20_000), 400))
        logs: dict[int, list[tuple[float, int | None, str]]] = {0: [], 1: [], 2: []}
        for number, seconds in enumerate(times):
            node = chance.choice((0, 0, 0, 1, 2))
            rank = chance.choice((None, 2 * node, 2 * node + 1))
            logs[node].append((seconds, rank, f"line {number} " + "x" * chance.randrange(600)))
        for node, lines in logs.items():
            write(run, attempt, node, lines)
    return run


@pytest.fixture
def more(kept: Run, tmp_path: Path) -> Run:
    """A copy that a test may add to."""
    return Run(shutil.copytree(kept.path, tmp_path / "run"))


def seen(lines: list[LogLine]) -> list[tuple[str, int, int, str]]:
    return [(line.time, line.attempt, line.node, line.text) for line in lines]


def backwards(chosen: Chosen, most: int) -> list[LogLine]:
    """All lines, window by window from the end."""
    place, found = chosen.end(), list[LogLine]()
    for _ in range(20_000):
        window = lines_before(chosen, place, most)
        assert len(window.lines) <= most
        found, place = window.lines + found, window.first
        if not window.more:
            break
    return found


@pytest.mark.parametrize("most", [7, 400, 10_000])
@pytest.mark.parametrize("which", [{}, {"node": 1}, {"rank": 3}, {"attempt": 1}, {"node": 0, "rank": 0, "attempt": 2}])
def test_going_back_window_by_window_gives_every_line_once_in_its_order(
    kept: Run, most: int, which: dict[str, int]
) -> None:
    found = backwards(Chosen(kept, JOB, **which), most)
    assert seen(found) == seen(list(LogView.of(kept, JOB, **which).drain()))


@pytest.mark.parametrize("most", [7, 250])
def test_going_on_from_any_window_gives_what_follows_it(kept: Run, most: int) -> None:
    chosen = Chosen(kept, JOB)
    everything = seen(list(LogView.of(kept, JOB).drain()))
    window = lines_before(chosen, lines_before(chosen, chosen.end(), 300).first, most)
    begin = everything.index(seen(window.lines)[0])
    assert seen(window.lines) == everything[begin : begin + most]
    after = lines_after(chosen, window.last, most)
    assert seen(after.lines) == everything[begin + most : begin + 2 * most] and after.more
    rest = lines_after(chosen, after.last, 10_000)
    assert seen(rest.lines) == everything[begin + 2 * most :] and not rest.more


def test_a_window_of_long_logs_reads_little_of_each(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run, nodes, read = Run(tmp_path / "run"), 8, list[int]()
    for node in range(nodes):
        append(run, "".join(line(second, "word " * 20) for second in range(10_000)), node)

    def counted(*given: Any) -> Chunk:
        chunk = read_log(*given)
        read.append(len(chunk.data))
        return chunk

    monkeypatch.setattr("shared_store.volume.log_files.read_log", counted)
    window = lines_after(Chosen(run, "job"), {}, 100)
    assert len(window.lines) == 100 and window.more and sum(read) <= nodes * 64 << 10


def test_a_follower_goes_on_from_the_end_of_the_last_window(more: Run) -> None:
    chosen = Chosen(more, JOB)
    window = lines_before(chosen, chosen.end())
    follower = LogView.of(more, JOB, offsets=dict(window.last))
    assert follower.poll() == []
    write(more, 2, 1, [(90_000, 2, "new")])
    write(more, 3, 0, [(91_000, 0, "of a new attempt")])
    assert [line.text for line in follower.poll()] == ["new", "of a new attempt"]


def test_half_a_line_belongs_to_no_window_yet(more: Run) -> None:
    chosen = Chosen(more, JOB)
    before = chosen.end()
    with open(more.log(JOB, 2, 0), "ab") as file:
        file.write(b"2026-01-01T00:00:00.000000Z 0 o half of")
    assert chosen.end() == before
    assert lines_before(chosen, chosen.end(), 1).lines[0].text.startswith("line 399 ")


def test_a_window_says_where_lines_were_deleted_and_goes_on_before_them(tmp_path: Path) -> None:
    run = Run(tmp_path)
    write(run, 1, 0, [(i, 0, f"{i} " + "x" * 2000) for i in range(1500)], LEAST_LOG_LIMIT)
    found = backwards(Chosen(run, JOB), 50)
    missing = [i for i, line in enumerate(found) if "left out: the log reached its limit" in line.text]
    assert len(missing) == 1 and found[0].text.startswith("0 ") and found[-1].text.startswith("1499 ")
    numbers = [int(line.text.split()[0]) for line in found if line.rank == 0]
    assert numbers == sorted(numbers) and len(numbers) == len(found) - 1


def test_a_line_that_is_longer_than_a_piece_is_in_a_window_like_any_other(tmp_path: Path) -> None:
    run = Run(tmp_path)
    chosen = Chosen(run, JOB)
    assert chosen.end() == {} and lines_before(chosen, {}).lines == [] and search(chosen, "x", {}).is_over
    write(run, 1, 0, [(1, 0, "a"), (2, 0, "b" * 200_000), (3, 0, "c")])
    assert [line.text[0] for line in lines_before(chosen, chosen.end()).lines] == ["a", "b", "c"]


def test_a_search_finds_every_line_with_the_text_and_goes_on_after_the_last_one(kept: Run) -> None:
    chosen = Chosen(kept, JOB)
    requested = {(line.attempt, line.text) for line in LogView.of(kept, JOB).drain() if "line 12" in line.text}
    found, place = list[LogLine](), {}
    while True:
        part = search(chosen, "LINE 12", place, 10)
        found, place = found + part.lines, part.place
        if part.is_over:
            break
        assert len(part.lines) == 10
    assert {(line.attempt, line.text) for line in found} == requested and len(found) == len(requested)
    of_rank = search(Chosen(kept, JOB, rank=3), "line", {}, 10_000).lines
    assert of_rank and all(line.rank == 3 and line.node == 1 for line in of_rank)
    (line,) = lines_before(chosen, {f"{found[5].attempt}/{found[5].node}": found[5].position}, 1).lines
    assert line == found[5], "a window that ends with what was found"


def test_the_first_error_of_each_node_is_found_and_words_like_it_are_not(tmp_path: Path) -> None:
    run = Run(tmp_path)
    plain = "iteration 1 tracking_error 0.1 error_vel 0.2 score_error 1 no errors so far"
    write(run, 1, 0, [(1, 0, plain), (2, 0, "Traceback (most recent call last):"), (3, 0, "ValueError: later")])
    write(run, 1, 1, [(1, 1, "torch.OutOfMemoryError: CUDA out of memory")])
    write(run, 1, 2, [(1, 2, plain)])
    write(run, 1, 3, [(1, 3, "can't start 'python': No such file or directory; is it installed?")])
    write(run, 1, 4, [(1, 4, "sh: 1: python: not found")])
    write(
        run,
        1,
        5,
        [(1, 5, "Warp CUDA warning: Could not find or load the NVIDIA CUDA driver. It was not found in time")],
    )
    found = first_error(Chosen(run, JOB), {})
    assert [line.node for line in found.lines] == [0, 1, 3, 4] and found.is_over
    assert found.lines[0].text.startswith("Traceback")
