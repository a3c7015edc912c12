"""What the worker's tests share."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.support.processes import end_all
from tests.support.worker import trained
from tests.support.worker.node import Node


@pytest.fixture
def node(tmp_path: Path) -> Iterator[Callable[..., Node]]:
    """Makes nodes on a store of the test's own; nothing of them is left behind."""
    made: list[Node] = []

    def make(**contract: Any) -> Node:
        made.append(Node(tmp_path, **contract))
        return made[-1]

    yield make
    for each in made:
        if hasattr(each, "process"):
            each.process.kill()
            each.process.wait()
    end_all(tmp_path)


@pytest.fixture(scope="session")
def trained_home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The home of a controller with a run that was trained (:mod:`tests.support.worker.trained`). To be copied, not written to."""
    return trained.make_once(tmp_path_factory)
