"""A run has one history of numbers, however often it was interrupted."""

from __future__ import annotations

import tempfile
import tracemalloc
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shared_store import metrics
from shared_store.layout import Run
from shared_store.metrics import MetricsHistory, MetricsWriter, history_of, read_metrics, sampled


def attempt(run: Run, epoch: int, resumed_from: int, last: int) -> None:
    with MetricsWriter(run, epoch, resumed_from) as writer:
        for iteration in range(resumed_from + 1, last + 1):
            writer.write({"iteration": iteration, "epoch": epoch})


def history(run: Run) -> list[tuple[int, int]]:
    return [(record["iteration"], record["epoch"]) for record in read_metrics(run)]


def test_a_run_without_metrics_has_an_empty_history(tmp_path: Path) -> None:
    assert read_metrics(Run(tmp_path)) == []


def test_a_written_record_is_read_at_once(tmp_path: Path) -> None:
    writer = MetricsWriter(Run(tmp_path), 1, 0)
    writer.write({"iteration": 1, "reward": 2.5, "episode_length": None})
    assert read_metrics(Run(tmp_path)) == [{"iteration": 1, "reward": 2.5, "episode_length": None}]
    writer.close()


def test_for_an_iteration_seen_twice_the_later_epoch_counts(tmp_path: Path) -> None:
    run = Run(tmp_path)
    attempt(run, 9, 0, 4)
    attempt(run, 10, 2, 6)
    assert history(run) == [(1, 9), (2, 9), (3, 10), (4, 10), (5, 10), (6, 10)]


def test_a_resume_drops_records_after_its_checkpoint(tmp_path: Path) -> None:
    run = Run(tmp_path)
    attempt(run, 1, 0, 10)
    attempt(run, 2, 4, 6)
    assert history(run) == [(1, 1), (2, 1), (3, 1), (4, 1), (5, 2), (6, 2)]


def test_an_attempt_that_died_before_its_first_iteration_still_supersedes_old_records(tmp_path: Path) -> None:
    run = Run(tmp_path)
    attempt(run, 1, 0, 5)
    attempt(run, 2, 3, 3)
    assert history(run) == [(1, 1), (2, 1), (3, 1)]


def test_only_iterations_after_the_given_one_are_returned(tmp_path: Path) -> None:
    attempt(Run(tmp_path), 1, 0, 5)
    assert [record["iteration"] for record in read_metrics(Run(tmp_path), after=3)] == [4, 5]


@pytest.mark.parametrize("torn", [b"{", b'{"iteration": 3, "epoch"', b'{"iteration": 3, "epoch": 1}', b"\0\0\0\0"])
def test_a_last_line_that_a_crash_cut_short_is_passed_over(tmp_path: Path, torn: bytes) -> None:
    run = Run(tmp_path)
    attempt(run, 1, 0, 2)
    with open(run.metrics / "metrics-e1.jsonl", "ab") as file:
        file.write(torn)
    assert history(run) == [(1, 1), (2, 1)]


def test_lines_that_are_no_records_and_files_that_are_not_ours_are_passed_over(tmp_path: Path) -> None:
    run = Run(tmp_path)
    attempt(run, 1, 0, 1)
    with open(run.metrics / "metrics-e1.jsonl", "ab") as file:
        file.write(b'[]\nnot json\n{"note": 1}\n\n{"iteration": 2, "epoch": 1}\n')
    (run.metrics / "events.out.tfevents.1").write_bytes(b"\0")
    (run.metrics / "metrics-e1.jsonl.bak").write_bytes(b'{"iteration": 9, "epoch": 1}\n')
    assert history(run) == [(1, 1), (2, 1)]


def test_a_number_that_is_not_finite_is_refused_because_json_lacks_it(tmp_path: Path) -> None:
    with MetricsWriter(Run(tmp_path), 1, 0) as writer, pytest.raises(ValueError):
        writer.write({"iteration": 1, "reward": float("nan")})
    assert read_metrics(Run(tmp_path)) == []


@settings(max_examples=40, deadline=None)
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


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 12), st.integers(0, 9), st.booleans()), min_size=1, max_size=6))
def test_a_cached_history_equals_a_newly_read_one_after_any_append(
    attempts: list[tuple[int, int, bool]],
) -> None:
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


def test_the_newest_record_of_a_long_history_is_read_without_the_rest(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run, parsed = Run(tmp_path), []
    genuine = metrics._record

    def counting(line: bytes) -> dict[str, Any]:
        parsed.append(line)
        return genuine(line)

    attempt(run, 1, 0, 20_000)
    history = MetricsHistory(run)
    assert len(history.after()) == 20_000
    monkeypatch.setattr(metrics, "_record", counting)
    with open(run.metrics / "metrics-e1.jsonl", "a") as file:
        file.write('{"iteration": 20001, "epoch": 1}\n{"iteration": 20002, "epo')
    assert [record["iteration"] for record in history.after(20_000)] == [20_001]
    last = history.last()
    assert last is not None and last["iteration"] == 20_001
    assert len(parsed) < 2000


def test_a_history_whose_file_was_replaced_is_read_from_the_start(tmp_path: Path) -> None:
    run = Run(tmp_path)
    attempt(run, 1, 0, 5)
    history = MetricsHistory(run)
    assert len(history.after()) == 5
    (run.metrics / "metrics-e1.jsonl").unlink()
    attempt(run, 1, 2, 9)
    assert [record["iteration"] for record in history.after()] == list(range(3, 10))


def test_a_line_of_any_length_is_passed_over_in_little_memory_and_never_read_again(tmp_path: Path) -> None:
    run = Run(tmp_path)
    attempt(run, 1, 0, 2)
    path = run.metrics / "metrics-e1.jsonl"
    with open(path, "ab") as file:
        file.truncate(path.stat().st_size + (200 << 20))  # a line of zeros without an end
    history = MetricsHistory(run)
    tracemalloc.start()
    try:
        looks = 0
        while history.after() and history.behind:
            looks += 1
        assert looks == 3, "64 MiB each"
        with open(path, "ab") as file:
            file.write(b'\n{"iteration": 3, "epoch": 1}\n')
        assert [record["iteration"] for record in history.after()] == [1, 2, 3]
        assert tracemalloc.get_traced_memory()[1] < 4 << 20
    finally:
        tracemalloc.stop()
    assert history_of(run).after(0, 2) == read_metrics(run)[:2]
    assert [record["iteration"] for record in read_metrics(run)] == [1, 2, 3]


def test_a_page_of_a_long_history_is_read_without_the_rest(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run, parsed = Run(tmp_path), []
    genuine = metrics._record
    attempt(run, 1, 0, 5000)
    attempt(run, 2, 2500, 6000)
    history = MetricsHistory(run)
    everything = history.after()

    def counting(line: bytes) -> dict[str, Any]:
        parsed.append(line)
        return genuine(line)

    monkeypatch.setattr(metrics, "_record", counting)
    for after in (0, 2400, 2499, 2500, 5990):
        page = [record for record in everything if record["iteration"] > after][:200]
        assert history.after(after, 200) == page
    assert len(parsed) < 10_000, "of 42,500 that five looks at everything would parse"


def points(run: Run, *arguments: int) -> list[tuple[int, int]]:
    return [(record["iteration"], record["epoch"]) for record in sampled(run, *arguments)]


def test_a_sample_of_a_short_history_is_all_of_it_and_of_none_is_nothing(tmp_path: Path) -> None:
    run = Run(tmp_path)
    assert sampled(run) == []
    attempt(run, 1, 0, 0)
    assert sampled(run) == []
    attempt(run, 2, 0, 7)
    assert points(run) == [(i, 2) for i in range(1, 8)]


def test_a_sample_of_a_long_history_is_spread_evenly_and_ends_with_its_newest_record(tmp_path: Path) -> None:
    run = Run(tmp_path)
    attempt(run, 1, 0, 20_000)
    found = [iteration for iteration, _ in points(run, 40)]
    assert len(found) == 40 and found[-1] == 20_000 and found == sorted(set(found))
    assert max(after - before for before, after in pairwise([0, *found])) < 1500
    with open(run.metrics / "metrics-e1.jsonl", "a") as file:
        file.write('{"iteration": 20001, "ep')
    assert points(run, 40)[-1] == (20_000, 1)


def test_a_sample_has_nothing_of_an_abandoned_past_and_ends_with_the_epoch_that_is_asked_for(tmp_path: Path) -> None:
    run = Run(tmp_path)
    attempt(run, 1, 0, 3000)
    attempt(run, 2, 1000, 5000)
    found = points(run, 60)
    assert found == sorted(set(found)) and found[-1] == (5000, 2)
    assert all((iteration > 1000) is (epoch == 2) for iteration, epoch in found)
    assert {epoch for _, epoch in found} == {1, 2}
    earlier = points(run, 60, 1)
    assert earlier[-1] == (3000, 1) and {epoch for _, epoch in earlier} == {1}
