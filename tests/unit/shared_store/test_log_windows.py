"""Windows of a job's log: backwards from any place, forwards, and by what the lines have."""

from __future__ import annotations

import random
import shutil
from pathlib import Path

import pytest

from shared_store.layout import Run
from shared_store.log_files import LEAST_LIMIT, LogWriter
from shared_store.log_windows import Chosen, first_error, lines_after, lines_before, search
from shared_store.logs import LogFollower, LogLine, format_line

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
def run(kept: Run, tmp_path: Path) -> Run:
    """A copy that a test may add to."""
    return Run(shutil.copytree(kept.path, tmp_path / "run"))


def texts(lines: list[LogLine]) -> list[tuple[str, int, int, str]]:
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
    assert texts(found) == texts(list(LogFollower(kept, JOB, **which).drain()))


@pytest.mark.parametrize("most", [7, 250])
def test_going_on_from_any_window_gives_what_follows_it(kept: Run, most: int) -> None:
    chosen = Chosen(kept, JOB)
    everything = texts(list(LogFollower(kept, JOB).drain()))
    window = lines_before(chosen, lines_before(chosen, chosen.end(), 300).first, most)
    begin = everything.index(texts(window.lines)[0])
    assert texts(window.lines) == everything[begin : begin + most]
    after = lines_after(chosen, window.last, most)
    assert texts(after.lines) == everything[begin + most : begin + 2 * most] and after.more
    rest = lines_after(chosen, after.last, 10_000)
    assert texts(rest.lines) == everything[begin + 2 * most :] and not rest.more


def test_a_follower_goes_on_from_the_end_of_the_last_window(run: Run) -> None:
    chosen = Chosen(run, JOB)
    window = lines_before(chosen, chosen.end())
    follower = LogFollower(run, JOB, offsets=dict(window.last))
    assert follower.poll() == []
    write(run, 2, 1, [(90_000, 2, "new")])
    write(run, 3, 0, [(91_000, 0, "of a new attempt")])
    assert [line.text for line in follower.poll()] == ["new", "of a new attempt"]


def test_half_a_line_belongs_to_no_window_yet(run: Run) -> None:
    chosen = Chosen(run, JOB)
    before = chosen.end()
    with open(run.log(JOB, 2, 0), "ab") as file:
        file.write(b"2026-01-01T00:00:00.000000Z 0 o half of")
    assert chosen.end() == before
    assert lines_before(chosen, chosen.end(), 1).lines[0].text.startswith("line 399 ")


def test_a_window_says_where_lines_were_deleted_and_goes_on_before_them(tmp_path: Path) -> None:
    run = Run(tmp_path)
    write(run, 1, 0, [(i, 0, f"{i} " + "x" * 2000) for i in range(1500)], LEAST_LIMIT)
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
    wanted = {(line.attempt, line.text) for line in LogFollower(kept, JOB).drain() if "line 12" in line.text}
    found, place = list[LogLine](), {}
    while True:
        part = search(chosen, "LINE 12", place, 10)
        found, place = found + part.lines, part.place
        if part.is_over:
            break
        assert len(part.lines) == 10
    assert {(line.attempt, line.text) for line in found} == wanted and len(found) == len(wanted)
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
    found = first_error(Chosen(run, JOB), {})
    assert [line.node for line in found.lines] == [0, 1] and found.is_over
    assert found.lines[0].text.startswith("Traceback")
