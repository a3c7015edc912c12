"""A run has one history of numbers, however often it was interrupted."""

from __future__ import annotations

import tempfile
import tracemalloc
from itertools import pairwise
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shared_store.volume import metrics
from shared_store.volume.layout import Run, Store
from shared_store.volume.metrics import MetricsHistory, MetricsWriter, history_of, read_metrics, sampled


@pytest.fixture
def parsed(monkeypatch: pytest.MonkeyPatch) -> list[bytes]:
    """The lines that are parsed."""
    genuine, found = metrics._record, list[bytes]()
    monkeypatch.setattr(metrics, "_record", lambda line: found.append(line) or genuine(line))
    return found


def attempt(run: Run, epoch: int, resumed_from: int, last: int) -> None:
    with MetricsWriter(run, epoch, resumed_from) as writer:
        for iteration in range(resumed_from + 1, last + 1):
            writer.write({"iteration": iteration, "epoch": epoch})


def history(run: Run) -> list[tuple[int, int]]:
    return [(record["iteration"], record["epoch"]) for record in read_metrics(run)]


def test_a_written_record_is_read_at_once(run: Run) -> None:
    assert read_metrics(run) == []
    with MetricsWriter(run, 1, 0) as writer:
        writer.write({"iteration": 1, "reward": 2.5, "episode_length": None})
        assert read_metrics(run) == [{"iteration": 1, "reward": 2.5, "episode_length": None}]
        with pytest.raises(ValueError):
            writer.write({"iteration": 2, "reward": float("nan")})  # JSON lacks it
    assert len(read_metrics(run)) == 1


def test_the_tenth_attempt_follows_the_ninth(run: Run) -> None:
    attempt(run, 9, 0, 4)
    attempt(run, 10, 2, 6)
    assert history(run) == [(1, 9), (2, 9), (3, 10), (4, 10), (5, 10), (6, 10)]
    assert [record["iteration"] for record in read_metrics(run, after=2)] == [3, 4, 5, 6]


@pytest.mark.parametrize("torn", [b"{", b'{"iteration": 3, "epoch"', b'{"iteration": 3, "epoch": 1}', b"\0\0\0\0"])
def test_a_last_line_that_a_crash_cut_short_is_passed_over(run: Run, torn: bytes) -> None:
    attempt(run, 1, 0, 2)
    with open(run.metrics / "metrics-e1.jsonl", "ab") as file:
        file.write(torn)
    assert history(run) == [(1, 1), (2, 1)]


def test_lines_that_are_not_records_and_files_that_are_not_ours_are_passed_over(run: Run) -> None:
    attempt(run, 1, 0, 1)
    with open(run.metrics / "metrics-e1.jsonl", "ab") as file:
        file.write(b'[]\nnot json\n{"note": 1}\n\n{"iteration": 2, "epoch": 1}\n')
    (run.metrics / "events.out.tfevents.1").write_bytes(b"\0")
    (run.metrics / "metrics-e1.jsonl.bak").write_bytes(b'{"iteration": 9, "epoch": 1}\n')
    assert history(run) == [(1, 1), (2, 1)]


@settings(max_examples=40)
@given(st.lists(st.tuples(st.integers(0, 12), st.integers(0, 6), st.booleans()), min_size=1, max_size=6))
def test_the_history_is_that_of_a_run_that_went_through_it_without_interruption(
    attempts: list[tuple[int, int, bool]],
) -> None:
    expected: list[tuple[int, int]] = []
    with tempfile.TemporaryDirectory() as directory:
        run = Run(Path(directory))
        for epoch, (back, steps, torn) in enumerate(attempts, start=1):
            resumed_from = max(0, len(expected) - back)
            attempt(run, epoch, resumed_from, resumed_from + steps)
            expected = expected[:resumed_from] + [(resumed_from + i + 1, epoch) for i in range(steps)]
            if torn:
                with open(run.metrics / f"metrics-e{epoch}.jsonl", "ab") as file:
                    file.write(b'{"iteration": 1, "epo')
        assert history(run) == expected


@settings(max_examples=60)
@given(st.lists(st.tuples(st.integers(0, 12), st.integers(0, 9), st.booleans()), min_size=1, max_size=6))
def test_a_cached_history_equals_a_newly_read_one_after_any_append(attempts: list[tuple[int, int, bool]]) -> None:
    with tempfile.TemporaryDirectory() as directory:
        run = Run(Path(directory))
        kept, expected = MetricsHistory(run), dict[int, int]()
        for epoch, (resumed_from, count, look) in enumerate(attempts, 1):
            attempt(run, epoch, resumed_from, resumed_from + count)
            expected = {i: e for i, e in expected.items() if i <= resumed_from}
            expected |= dict.fromkeys(range(resumed_from + 1, resumed_from + count + 1), epoch)
            if look:
                kept.last()
            for after in (0, resumed_from, resumed_from + count - 1):
                found = [(record["iteration"], record["epoch"]) for record in kept.after(after)]
                assert found == sorted(item for item in expected.items() if item[0] > after)
        last = kept.last()
        assert (last and (last["iteration"], last["epoch"])) == max(expected.items(), default=None)


def test_the_newest_record_of_a_long_history_is_read_without_the_rest(run: Run, parsed: list[bytes]) -> None:
    attempt(run, 1, 0, 20_000)
    history = MetricsHistory(run)
    assert len(history.after()) == 20_000
    parsed.clear()
    with open(run.metrics / "metrics-e1.jsonl", "a") as file:
        file.write('{"iteration": 20001, "epoch": 1}\n{"iteration": 20002, "epo')
    assert [record["iteration"] for record in history.after(20_000)] == [20_001]
    last = history.last()
    assert last is not None and last["iteration"] == 20_001
    assert len(parsed) < 2000


def test_a_history_whose_file_was_replaced_is_read_from_the_start(run: Run) -> None:
    attempt(run, 1, 0, 5)
    history = MetricsHistory(run)
    assert len(history.after()) == 5
    (run.metrics / "metrics-e1.jsonl").unlink()
    attempt(run, 1, 2, 9)
    assert [record["iteration"] for record in history.after()] == list(range(3, 10))


def test_a_line_of_any_length_is_passed_over_in_little_memory_and_never_read_again(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(metrics, "_LOOK", 8 << 20)
    attempt(run, 1, 0, 2)
    path = run.metrics / "metrics-e1.jsonl"
    with open(path, "ab") as file:
        file.truncate(path.stat().st_size + (25 << 20))  # a line of zeros without an end
    history = MetricsHistory(run)
    tracemalloc.start()
    try:
        looks = 0
        while history.after() and history.behind:
            looks += 1
        assert looks == 3, "8 MiB each"
        with open(path, "ab") as file:
            file.write(b'\n{"iteration": 3, "epoch": 1}\n')
        assert [record["iteration"] for record in history.after()] == [1, 2, 3]
        assert tracemalloc.get_traced_memory()[1] < 4 << 20
    finally:
        tracemalloc.stop()
    assert history_of(run).after(0, 2) == read_metrics(run)[:2]
    assert [record["iteration"] for record in read_metrics(run)] == [1, 2, 3]


def test_a_page_of_a_long_history_is_read_without_the_rest(run: Run, parsed: list[bytes]) -> None:
    attempt(run, 1, 0, 5000)
    attempt(run, 2, 2500, 6000)
    history = MetricsHistory(run)
    everything = history.after()
    parsed.clear()
    for after in (0, 2400, 2499, 2500, 5990):
        page = [record for record in everything if record["iteration"] > after][:200]
        assert history.after(after, 200) == page
    assert len(parsed) < 10_000, "of 42,500 that five looks at everything would parse"


def points(run: Run, *arguments: int) -> list[tuple[int, int]]:
    return [(record["iteration"], record["epoch"]) for record in sampled(run, *arguments)]


def test_a_sample_of_a_long_history_is_spread_evenly_and_ends_with_its_newest_record(run: Run) -> None:
    attempt(run, 1, 0, 5000)
    found = [iteration for iteration, _ in points(run, 40)]
    assert len(found) == 40 and found[-1] == 5000 and found == sorted(set(found))
    assert max(after - before for before, after in pairwise([0, *found])) < 375
    with open(run.metrics / "metrics-e1.jsonl", "a") as file:
        file.write('{"iteration": 5001, "ep')
    assert points(run, 40)[-1] == (5000, 1)


def test_a_sample_has_nothing_of_an_abandoned_past_and_ends_with_the_epoch_that_is_asked_for(run: Run) -> None:
    attempt(run, 1, 0, 3000)
    attempt(run, 2, 1000, 5000)
    found = points(run, 60)
    assert found == sorted(set(found)) and found[-1] == (5000, 2)
    assert all((iteration > 1000) is (epoch == 2) for iteration, epoch in found)
    assert {epoch for _, epoch in found} == {1, 2}
    earlier = points(run, 60, 1)
    assert earlier[-1] == (3000, 1) and {epoch for _, epoch in earlier} == {1}


def test_where_the_run_is_not_nothing_is_made_and_all_records_come_once_it_is_back(tmp_path: Path) -> None:
    run = Store(tmp_path / "store").open().run("away")
    with MetricsWriter(run, 1, 0) as writer:
        with pytest.raises(OSError):
            writer.write({"iteration": 1})
        assert not run.path.exists()
        run.path.mkdir()
        writer.write({"iteration": 2})
    assert [each["iteration"] for each in read_metrics(run)] == [1, 2]
