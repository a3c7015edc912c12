"""The graph of a model's origin."""

from __future__ import annotations

from typing import Any

from orchestrator.console.lineage import Drawing, drawing


def version(number: int, run: str, parent: dict[str, Any] | None = None) -> dict[str, Any]:
    return {"name": "fast", "version": number, "run": run, "iteration": 9, "parent": parent, "score": 2.0}


def drawn(*versions: dict[str, Any], **parents: str) -> Drawing:
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
