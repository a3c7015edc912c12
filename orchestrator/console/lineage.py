"""The lineage of a model, as a graph that the server draws: runs and the clones of their checkpoints, then versions of the model."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

_MOST = 40
"""Runs of a graph."""
_BOX = (190, 44)
_GAP = (60, 16)


@dataclass(frozen=True)
class Vertex:
    """A run or a version in the drawing; x and y of its upper left corner [px]."""

    title: str
    about: str
    link: str
    x: int
    y: int
    is_chosen: bool = False

    @property
    def shown(self) -> str:
        """The title where it fits."""
        return self.title if len(self.title) < 25 else f"{self.title[:23]}…"


@dataclass(frozen=True)
class Edge:
    """From the right of one box to the left of another [px], with the checkpoint between them."""

    x1: int
    y1: int
    x2: int
    y2: int
    label: str


@dataclass(frozen=True)
class LineageGraph:
    """The whole graph."""

    boxes: Sequence[Vertex]
    lines: Sequence[Edge]
    width: int
    height: int


@dataclass
class _Node:
    title: str
    about: str = ""
    link: str = ""
    level: int = 0
    is_chosen: bool = False
    parents: dict[str, str] = field(default_factory=dict)
    """By key of the parent: the checkpoint."""


Parent = Callable[[str], Mapping[str, Any] | None]
"""``parent`` of a run (``run``, ``iteration``); None where it has none, is gone or may not be seen."""


def drawing(versions: Sequence[Mapping[str, Any]], chosen: int, parent_of: Parent) -> LineageGraph:
    """The graph of a model.

    Args:
        versions: ``model.json`` of each version that the caller may see.
        chosen: The version that the page shows.
        parent_of: Looks up the parent of a run.
    """
    nodes: dict[str, _Node] = {}
    for each in versions:
        name, run = f"{each['name']}@{each['version']}", str(each.get("run"))
        score = each.get("score")
        about = "" if not isinstance(score, int | float) else f"score {score:.2f}"
        place = f"/models/{each['name']}?version={each['version']}"
        iteration = str(each.get("iteration", "?"))
        nodes[f"model {each['version']}"] = _Node(
            name, about, place, is_chosen=each["version"] == chosen, parents={f"run {run}": iteration}
        )
        _add_run(nodes, run, each.get("parent"), parent_of)
    for key in nodes:
        _level(nodes, key, ())
    return _placed(nodes)


def _add_run(nodes: dict[str, _Node], run: str, parent: Any, parent_of: Parent) -> None:
    """Add a run and all its ancestors; a model keeps its run's parent even where the run is gone."""
    while f"run {run}" not in nodes and len(nodes) < _MOST:
        node = nodes[f"run {run}"] = _Node(run, "run", f"/runs/{run}")
        parent = parent if isinstance(parent, Mapping) else parent_of(run)
        if not parent or not parent.get("run"):
            return
        run = str(parent["run"])
        node.parents[f"run {run}"] = str(parent.get("iteration", "?"))
        parent = None


def _level(nodes: Mapping[str, _Node], key: str, above: tuple[str, ...]) -> int:
    """The longest way from a run without a parent; a run that is its own ancestor, in a damaged store, counts once."""
    node = nodes[key]
    before = [
        _level(nodes, each, (*above, key)) for each in node.parents if each in nodes and each not in (*above, key)
    ]
    node.level = max(before, default=-1) + 1
    return node.level


def _placed(nodes: Mapping[str, _Node]) -> LineageGraph:
    rows: dict[int, int] = {}
    boxes: dict[str, Vertex] = {}
    for key, node in nodes.items():
        row = rows[node.level] = rows.get(node.level, -1) + 1
        x, y = node.level * (_BOX[0] + _GAP[0]), row * (_BOX[1] + _GAP[1])
        boxes[key] = Vertex(node.title, node.about, node.link, x, y, node.is_chosen)
    lines = [
        Edge(boxes[parent].x + _BOX[0], boxes[parent].y + 22, boxes[key].x, boxes[key].y + 22, f"@{checkpoint}")
        for key, node in nodes.items()
        for parent, checkpoint in node.parents.items()
        if parent in boxes
    ]
    width = max((box.x for box in boxes.values()), default=0) + _BOX[0]
    height = max((box.y for box in boxes.values()), default=0) + _BOX[1]
    return LineageGraph(list(boxes.values()), lines, width + 2, height + 2)
