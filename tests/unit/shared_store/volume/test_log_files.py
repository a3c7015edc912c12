"""A log keeps its head and its tail within its limit; followers get every line once, and a count of those that are gone."""

from __future__ import annotations

import os
import random
import tracemalloc
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import pytest

from orchestrator.api.logs import log_events
from orchestrator.api.logs.log_events import LogFile
from shared_store.contract.node import LEAST_LOG_LIMIT
from shared_store.volume.layout import Run
from shared_store.volume.log_files import LogWriter, left_out, segments_of
from shared_store.volume.log_view import LogView
from shared_store.volume.logs import REPLACED, format_line, timestamp

START = 1_800_000_000.0
LIMIT = LEAST_LOG_LIMIT


def lines_of(first: int, count: int, size: int = 650) -> bytes:
    """Lines that carry their number, a millisecond apart."""
    return "".join(
        format_line(START + i / 1000, 0, "o", f"{i:08d} {'x' * size}") for i in range(first, first + count)
    ).encode()


def numbers(texts: list[str]) -> list[int]:
    return [int(text[:8]) for text in texts if text[:8].isdigit()]


def more(writer: LogWriter, first: int, end: int, step: int = 100) -> LogWriter:
    """Write these lines, some at a time."""
    for each in range(first, end, step):
        data = lines_of(each, min(step, end - each))
        assert writer.append(data) == len(data)
    return writer


def written(path: Path, count: int) -> LogWriter:
    return more(LogWriter(path, LIMIT), 0, count)


def drained(run: Run) -> list[str]:
    return [line.text for line in LogView.of(run, "job").drain()]


def test_a_log_beyond_its_limit_keeps_both_ends_and_counts_the_middle(run: Run) -> None:
    path, count = run.log("job", 1, 0), 10_000
    writer = written(path, 200)
    assert [segment.path.name for segment in segments_of(path)] == ["node-0.log"], "within its limit it is one file"
    assert more(writer, 200, count).lines == count
    size = sum(segment.path.stat().st_size for segment in segments_of(path))
    assert LIMIT * 0.9 < size <= LIMIT
    texts = drained(run)
    kept = numbers(texts)
    assert len(texts) == len(kept) + 1
    gap = next(place for place, text in enumerate(texts) if text.startswith("…"))
    head, tail = kept[:gap], kept[gap:]
    assert head == list(range(len(head))) and tail == list(range(tail[0], count))
    missing = tail[0] - len(head)
    assert texts[gap] == left_out(missing, len(lines_of(0, missing)), "the log reached its limit")
    assert abs(len(head) - len(tail)) < 0.2 * len(head)


def test_a_follower_that_keeps_up_gets_every_line_once_whatever_is_deleted_behind_it(run: Run) -> None:
    dice, writer, follower = random.Random(3), LogWriter(run.log("job", 1, 0), LIMIT), LogView.of(run, "job")
    count, texts = 0, []
    while count < 8000:
        more = dice.randrange(1, 180)
        data = lines_of(count, more, dice.randrange(1500))
        assert writer.append(data) == len(data)
        count += more
        if dice.random() < 0.9:
            follower = LogView.of(run, "job", offsets=follower.offsets) if dice.random() < 0.1 else follower
            texts += [line.text for line in follower.drain()]
    texts += [line.text for line in follower.drain()]
    assert numbers(texts) == list(range(count)) and len(texts) == count


def test_a_follower_that_falls_behind_learns_how_much_it_missed(run: Run) -> None:
    writer, follower = written(run.log("job", 1, 0), 1200), LogView.of(run, "job")
    before = [line.text for line in follower.drain()]
    position = follower.offsets["1/0"]
    more(writer, 1200, 10_000)
    after = [line.text for line in follower.drain()]
    tail = segments_of(run.log("job", 1, 0))[1]
    assert numbers(before) == list(range(1200))
    assert after[0] == left_out(None, tail.start - position, "the log reached its limit")
    assert numbers(after)[-1] == 9_999 and all(b == a + 1 for a, b in pairwise(numbers(after)))


def test_a_restarted_writer_continues_where_the_killed_one_stopped(run: Run) -> None:
    path = run.log("job", 1, 0)
    written(path, 1800).close()
    last = segments_of(path)[-1].path
    with open(last, "ab") as file:
        file.write(b"2027-01-15T08:00:00.000000Z 0 o half a li")
    again = LogWriter(path, LIMIT)
    assert again.lines == 1800
    again.append(lines_of(1800, 200))
    assert again.lines == 2000
    assert numbers(drained(run))[-200:] == list(range(1800, 2000))


def test_a_line_longer_than_a_file_of_the_log_is_kept_whole(run: Run) -> None:
    writer = LogWriter(run.log("job", 1, 0), LIMIT)
    long = [format_line(START, 0, "o", f"{i} " + "y" * 300_000).encode() for i in range(6)]
    assert writer.append(b"".join(long)) == sum(map(len, long))
    texts = drained(run)
    assert texts[0].startswith("0 ") and texts[-1] == "5 " + "y" * 300_000


@pytest.fixture
def small(tmp_path: Path) -> Iterator[Run]:
    """On a volume of its own of 8 MiB."""
    if os.geteuid() != 0 or os.system(f"mount -t tmpfs -o size=8m none {tmp_path}") != 0:
        pytest.skip("NOT TESTED: only root can mount a small volume")
    yield Run(tmp_path)
    os.system(f"umount -l {tmp_path}")


def fill(run: Run) -> Path:
    filler, volume = run.path / "filler", os.statvfs(run.path)
    filler.write_bytes(b"x" * volume.f_bavail * volume.f_frsize)
    return filler


def test_a_full_volume_takes_whole_lines_only_and_the_log_goes_on_when_there_is_room(small: Run) -> None:
    path = small.log("job", 1, 0)
    writer = LogWriter(path, 64 << 20)
    assert writer.append(lines_of(0, 200)) > 0 and writer.error is None
    filler = fill(small)
    assert writer.append(lines_of(200, 200)) == 0 and writer.error is not None
    assert path.read_bytes() == lines_of(0, 200)
    filler.unlink()
    assert writer.append(lines_of(400, 200)) == len(lines_of(400, 200)) and writer.error is None
    assert path.read_bytes() == lines_of(0, 200) + lines_of(400, 200)


def test_half_a_line_that_a_full_volume_took_is_taken_back(small: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(LogWriter, "_check_room", lambda *_: None)  # as where a quota ends, which no volume tells
    path = small.log("job", 1, 0)
    writer = LogWriter(path, 64 << 20)
    writer.append(lines_of(0, 20))
    filler = fill(small)
    os.truncate(filler, filler.stat().st_size - 8192)
    data = lines_of(20, 200)
    written = writer.append(data)
    assert 4000 < written < len(data) and data[:written].endswith(b"\n") and writer.error is not None
    assert path.read_bytes() == lines_of(0, 20) + data[:written]


def test_no_log_fills_a_volume_and_on_a_full_one_its_end_is_still_kept(small: Run) -> None:
    writer = LogWriter(small.log("job", 1, 0), 1 << 30)
    volume = os.statvfs(small.path)
    more(writer, 0, 16_000)
    assert os.statvfs(small.path).f_bavail > 0.7 * volume.f_bavail
    fill(small)
    more(writer, 16_000, 20_000)
    texts = drained(small)
    kept = numbers(texts)
    assert kept[0] == 0 and kept[-1] == 19_999 and sum("left out" in text for text in texts) == 1


def test_lines_of_a_node_keep_their_order_when_its_clock_is_set_back(run: Run) -> None:
    clock = [START, START + 1, START - 86_400, START - 86_399, START + 2]
    lines = "".join(format_line(at, 0, "o", f"a{i}") for i, at in enumerate(clock))
    LogWriter(run.log("job", 1, 0)).append(lines.encode())
    LogWriter(run.log("job", 1, 1)).append(format_line(START + 1.5, 1, "o", "b").encode())
    merged = list(LogView.of(run, "job").drain())
    assert [line.text for line in merged] == ["a0", "a1", "a2", "a3", "b", "a4"]
    assert merged[2].time == timestamp(START - 86_400), "the time that the node wrote is shown"


def test_logs_of_different_length_are_merged_by_time_from_beginning_to_end(run: Run) -> None:
    sizes = {0: 3000, 1: 50, 2: 400}
    for node, size in sizes.items():
        lines = [format_line(START + i + node / 10, node, "o", "z" * size) for i in range(1200)]
        LogWriter(run.log("job", 1, node)).append("".join(lines).encode())
    LogWriter(run.log("job", 2, 0)).append(format_line(START, 0, "o", "second attempt").encode())
    lines = list(LogView.of(run, "job").drain())
    assert len(lines) == 3601
    keys = [(line.attempt, line.time) for line in lines]
    assert keys == sorted(keys)


@pytest.mark.parametrize("how", ["truncated", "replaced by a shorter one", "replaced by a longer one"])
def test_a_truncated_or_replaced_log_is_reported_and_followed_from_its_new_beginning(run: Run, how: str) -> None:
    path = run.log("job", 1, 0)
    LogWriter(path).append(lines_of(0, 100))
    follower, file = LogView.of(run, "job"), LogFile(path, "stream")
    assert len(follower.poll()) == 100 and file.snapshot().started == 1
    if how == "truncated":
        os.truncate(path, 0)
        assert [line.text for line in follower.poll()] == [REPLACED]
    else:
        path.unlink()
    LogWriter(path).append(lines_of(500, 60 if "shorter" in how else 300))
    texts = [line.text for line in follower.poll()]
    assert texts[0] == REPLACED or how == "truncated"
    assert numbers(texts)[0] == 500 and len(numbers(texts)) == (60 if "shorter" in how else 300)
    assert [line.text for line in follower.poll()] == []
    view = file.snapshot()
    assert view.started == 2 and numbers([event.text for event in view.forward()])[0] == 500


def test_events_of_a_long_log_are_the_same_for_whoever_looks_and_whenever(run: Run) -> None:
    path = run.log("job", 1, 0)
    early, writer = LogFile(path, "stream"), LogWriter(path, LIMIT)
    for first in range(0, 8000, 1400):
        more(writer, first, min(first + 1400, 8000))
        early.snapshot()
    late = LogFile(path, "stream").snapshot()
    seen = list(early.snapshot().forward())
    assert seen == list(late.forward()) == list(late.backward())[::-1]
    gap = next(event for event in seen if event.text.startswith("…"))
    texts = drained(run)
    assert [event.text for event in seen] == texts
    inside = list(late.forward(start=gap.offset + 1000))
    assert inside[0].text == gap.text
    assert numbers([event.text for event in inside])[0] == numbers(texts)[texts.index(gap.text)]
    assert all(event.end == after.offset for event, after in pairwise(seen))
    for event in random.Random(1).sample(seen, 50):
        assert next(late.forward(start=event.offset)) == event


def test_a_view_survives_the_deletion_of_files_that_it_knows(run: Run) -> None:
    path = run.log("job", 1, 0)
    writer = written(path, 2400)
    view = LogFile(path, "stream").snapshot()
    more(writer, 2400, 8000)
    assert numbers([event.text for event in view.forward()])[:700] == list(range(700))


def test_counting_the_lines_of_a_log_takes_no_memory_of_its_size(tmp_path: Path) -> None:
    path = tmp_path / "node-0.log"
    with open(path, "wb") as file:
        file.write(b"one\n")
        file.seek(40 << 20)
        file.write(b"\ntwo\n")
    tracemalloc.start()
    try:
        assert LogWriter(path, 1 << 30).lines == 3
        assert tracemalloc.get_traced_memory()[1] < 8 << 20
    finally:
        tracemalloc.stop()


def test_one_look_passes_over_a_bounded_part_of_a_hole_and_the_next_one_goes_on(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(log_events, "_MOST_SKIPPED", 4 << 20)
    path = run.log("job", 1, 0)
    path.parent.mkdir(parents=True)
    first, last = lines_of(0, 1), lines_of(1, 1)
    path.write_bytes(first)
    with open(path, "ab") as file:
        file.truncate(len(first) + (6 << 20))
        file.write(b"\n" + last)
    log = LogFile(path, "stream")
    assert log.snapshot().end < 5.5 * (1 << 20)
    view = log.snapshot()
    assert view.end == path.stat().st_size
    assert numbers([event.text for event in view.backward()]) == [1, 0]
