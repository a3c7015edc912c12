"""The lineage of a model, as a graph that the server draws: runs and the clones of their checkpoints, then versions of the model."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

_MOST = 40
"""Runs of a graph."""
_BOX = (190, 44)
_GAP = (60, 16)


@dataclass
class Vertex:
    """A run or a version in the drawing; x and y of its upper left corner [px]."""

    title: str
    about: str
    link: str
    parents: dict[str, str] = field(default_factory=dict)
    """By key of the parent: the checkpoint."""
    is_chosen: bool = False
    level: int = 0
    """Length of the longest way from a run without a parent."""
    x: int = 0
    y: int = 0

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


Parent = Callable[[str], Mapping[str, Any] | None]
"""``parent`` of a run (``run``, ``iteration``); None where it has none, is gone or may not be seen."""


def drawing(versions: Sequence[Mapping[str, Any]], chosen: int, parent_of: Parent) -> LineageGraph:
    """The graph of a model.

    Args:
        versions: ``model.json`` of each version that the caller may see.
        chosen: The version that the page shows.
        parent_of: Looks up the parent of a run.
    """
    nodes: dict[str, Vertex] = {}
    for each in versions:
        number, run, score = each["version"], str(each.get("run")), each.get("score")
        about = f"score {score:.2f}" if isinstance(score, int | float) else ""
        link, parents = f"/models/{each['name']}?version={number}", {f"run {run}": str(each.get("iteration", "?"))}
        nodes[f"model {number}"] = Vertex(f"{each['name']}@{number}", about, link, parents, number == chosen)
        _add_run(nodes, run, each.get("parent"), parent_of)
    for key in nodes:
        _find_level(nodes, key, ())
    return _placed(nodes)


def _add_run(nodes: dict[str, Vertex], run: str, parent: Any, parent_of: Parent) -> None:
    """Add a run and all its ancestors; a model keeps its run's parent even where the run is gone."""
    while f"run {run}" not in nodes and len(nodes) < _MOST:
        node = nodes[f"run {run}"] = Vertex(run, "run", f"/runs/{run}")
        parent = parent if isinstance(parent, Mapping) else parent_of(run)
        if not parent or not parent.get("run"):
            return
        run = str(parent["run"])
        node.parents[f"run {run}"] = str(parent.get("iteration", "?"))
        parent = None


def _find_level(nodes: Mapping[str, Vertex], key: str, above: tuple[str, ...]) -> int:
    """Set the level of a node; a run that is its own ancestor, in a damaged store, counts once."""
    node, above = nodes[key], (*above, key)
    before = [_find_level(nodes, each, above) for each in node.parents if each in nodes and each not in above]
    node.level = max(before, default=-1) + 1
    return node.level


def _placed(nodes: Mapping[str, Vertex]) -> LineageGraph:
    rows = Counter[int]()
    for box in nodes.values():
        box.x, box.y = box.level * (_BOX[0] + _GAP[0]), rows[box.level] * (_BOX[1] + _GAP[1])
        rows[box.level] += 1
    lines = [
        Edge(nodes[parent].x + _BOX[0], nodes[parent].y + 22, box.x, box.y + 22, f"@{checkpoint}")
        for box in nodes.values()
        for parent, checkpoint in box.parents.items()
        if parent in nodes
    ]
    width, height = (max((getattr(box, axis) for box in nodes.values()), default=0) for axis in "xy")
    return LineageGraph(list(nodes.values()), lines, width + _BOX[0] + 2, height + _BOX[1] + 2)
