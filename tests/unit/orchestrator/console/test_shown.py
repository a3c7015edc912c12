"""What the console's pages show: numbers and times, curves, a model's origin, the code of a job."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from orchestrator.console import formats as words
from orchestrator.console.curves import columns, curves_of, number
from orchestrator.console.job_config import code_of, differences
from orchestrator.console.lineage import LineageGraph, drawing
from shared_store.volume.layout import Run
from shared_store.volume.metrics import MetricsWriter

DURATIONS = {
    None: "",
    -3: "0 s",
    59.9: "59 s",
    60: "1 min",
    3600: "1 h",
    3660: "1 h 1 min",
    86400: "1 d",
    90061: "1 d 1 h",
}
NUMBERS = {None: "", 0: "0", 12: "12", 3.4567: "3.46", -0.01234: "-0.0123", 1234.5: "1234", 18_240: "18.2 k"}
NUMBERS |= {1_070_000: "1.07 M", -2.5e10: "-25.0 G"}


def test_a_duration_has_its_two_largest_units_and_a_number_three_or_four_digits_and_a_unit() -> None:
    assert {seconds: words.duration(seconds) for seconds in DURATIONS} == DURATIONS
    assert {value: words.count(value) for value in NUMBERS} == NUMBERS


@given(st.lists(st.floats(-1e12, 1e12), min_size=2, max_size=60))
def test_the_points_of_a_curve_stay_in_their_box_and_keep_their_order(values: list[float]) -> None:
    points = [tuple(map(float, each.split(","))) for each in words.spark(values).split()]
    assert len(points) == len(values)
    assert all(0 <= x <= 100 and 0 <= y <= 24 for x, y in points)
    assert points == sorted(points, key=lambda point: point[0])


def test_a_curve_of_equal_values_is_flat_and_a_time_is_written_and_read_again() -> None:
    assert words.spark([1.0]) == "" and {each.partition(",")[2] for each in words.spark([2, 2, 2]).split()} == {"22.0"}
    assert words.moment(1_700_000_000_000) == "2023-11-14T22:13:20+00:00"
    assert {words.moment(each) for each in (None, "x", 1e300, True)} == {""} and words.age(None) == ""
    assert '<time datetime="2023-11-14T22:13:20+00:00" data-since>' in words.age(1_700_000_000, 1000)


METRICS = 8


def record(iteration: int) -> dict[str, Any]:
    terms = {f"reward_{i}": iteration * i / 10 for i in range(METRICS - 2)}
    return {"iteration": iteration, "reward": float(iteration), "note": "text", "kl": None, "done": True, **terms}


@pytest.fixture(scope="module")
def long_run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """10,000 iterations of some metrics."""
    run = Run(tmp_path_factory.mktemp("long"))
    with MetricsWriter(run, 1, 0) as writer:
        for iteration in range(1, 10_001):
            writer.write(record(iteration))
    return run


def test_a_long_history_is_thinned_to_points_from_its_first_iteration_to_its_last(long_run: Run) -> None:
    found = curves_of(long_run, ["reward"], points=300)
    iterations = found["iterations"]
    assert len(iterations) <= 300 and iterations[0] <= 50 and iterations[-1] == found["last"] == 10_000
    assert max(b - a for a, b in pairwise(iterations)) <= 100
    assert found["series"]["reward"] == iterations


@pytest.mark.parametrize(("begin", "end", "step"), [(500, 599, 1), (1, 100, 1), (3000, 6000, 31), (200, 9000, 60)])
def test_a_window_has_its_own_points(long_run: Run, begin: int, end: int, step: int) -> None:
    iterations = curves_of(long_run, ["reward"], begin, end, 300)["iterations"]
    assert begin <= iterations[0] <= begin + step and end - step <= iterations[-1] <= end
    assert max(b - a for a, b in pairwise(iterations)) <= step


def test_a_window_beyond_the_end_is_empty_and_a_run_without_metrics_has_no_curves(
    long_run: Run, tmp_path: Path
) -> None:
    assert curves_of(long_run, [], 10_001)["iterations"] == []
    assert curves_of(Run(tmp_path)) == {"first": 0, "last": 0, "iterations": [], "series": {}}


def test_what_an_attempt_has_superseded_is_in_no_curve(tmp_path: Path) -> None:
    run = Run(tmp_path)
    with MetricsWriter(run, 1, 0) as writer:
        for iteration in range(1, 11):
            writer.write({"iteration": iteration, "reward": 1})
    with MetricsWriter(run, 2, 4) as writer:
        writer.write({"iteration": 5, "reward": 2})
    assert curves_of(run)["series"]["reward"] == [1, 1, 1, 1, 2]


def test_names_choose_metrics_and_groups_only_numbers_are_drawn_and_each_rank_has_its_curve() -> None:
    records = [record(1), {"iteration": 2, "reward": None, "reward_1": 3.0}]
    assert columns(records, ["reward", "kl", "nothing"])["series"] == {"reward": [1.0, None]}
    assert len(columns(records, ["reward_*"])["series"]) == METRICS - 2
    assert set(columns(records, ["done", "note", "reward_1"])["series"]) == {"reward_1"}
    shown = {"1": None, 1 / 3: 0.333333, 12345678901: 12345678901}
    assert {value: number(value) for value in shown} == shown and number(float("nan")) is None
    records = [{"iteration": 1, "rank_collect_seconds": [0.1, 0.3]}, {"iteration": 2, "rank_collect_seconds": [0.2]}]
    expected = {"rank_collect_seconds/0": [0.1, 0.2], "rank_collect_seconds/1": [0.3, None]}
    assert columns(records, ["rank_*"])["series"] == columns(records, ["*"])["series"] == expected


def version(number: int, run: str, parent: dict[str, Any] | None = None) -> dict[str, Any]:
    return {"name": "fast", "version": number, "run": run, "iteration": 9, "parent": parent, "score": 2.0}


def drawn(*versions: dict[str, Any], **parents: str) -> LineageGraph:
    found = {run: {"run": parent, "iteration": 5} for run, parent in parents.items()}
    return drawing(versions, 1, found.get)


def test_every_ancestor_stands_left_of_what_comes_from_it() -> None:
    graph = drawn(version(1, "a"), version(2, "c", {"run": "b", "iteration": 7}), b="a")
    at = {box.title: box for box in graph.boxes}
    assert [at[name].x for name in ("a", "b", "c", "fast@2")] == [0, 250, 500, 750]
    assert at["fast@1"].x == 250 and at["fast@1"].is_chosen and not at["fast@2"].is_chosen
    assert sorted(line.label for line in graph.lines) == ["@5", "@7", "@9", "@9"]
    places = {(box.x, box.y) for box in graph.boxes}
    assert len(places) == len(graph.boxes) and max(x for x, _ in places) < graph.width


def test_runs_that_are_gone_end_their_line_and_those_that_come_from_each_other_are_drawn_once() -> None:
    graph = drawn(version(1, "b", {"run": "gone", "iteration": 3}))
    assert [box.title for box in graph.boxes] == ["fast@1", "b", "gone"]
    graph = drawn(version(1, "a"), a="b", b="a")
    assert {box.title for box in graph.boxes} == {"fast@1", "a", "b"}


def test_a_long_line_of_clones_is_cut_and_a_long_name_is_shortened() -> None:
    graph = drawn(version(1, "r0"), **{f"r{i}": f"r{i + 1}" for i in range(200)})
    assert len(graph.boxes) == 40
    (box,) = [each for each in drawn(version(1, "x" * 60)).boxes if each.title.startswith("x")]
    assert len(box.shown) == 24


CODE = "def reward_function(params):\n    speed = params['speed']\n    return speed\n"


def holding(text: str) -> dict[str, Any]:
    return {
        "name": "fast",
        "train": {"task": "elsewhere.mine:Task", "config": {"reward_function": {"file": "mine.py", "text": text}}},
    }


def test_the_files_that_a_job_holds_are_its_code() -> None:
    assert code_of(holding(CODE)) == [("mine.py", CODE)]
    assert code_of({"name": "a", "command": ["true"], "environment": {"file": "x"}}) == []


def test_of_two_texts_the_lines_that_differ_are_shown_of_long_ones_from_their_beginning() -> None:
    changed = CODE.replace("return speed", "return 2 * speed") + "# faster\n"
    assert differences(holding(CODE), holding(changed)) == [
        ("train.config.reward_function.text", "3:     return speed", "3:     return 2 * speed\n4: # faster")
    ]
    assert differences({"seed": 1, "name": "a"}, {"seed": 2}) == [("seed", "1", "2"), ("name", "a", "")]
    ((_, was, now),) = differences(holding("a\n" * 2000), holding("b\n" * 2000))
    assert was.startswith("a\na\n") and was.endswith(" …") and now.startswith("b\nb\n") and len(now) < 310
