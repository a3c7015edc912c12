"""What the definitions of stored jobs say, read once."""

from __future__ import annotations

from typing import Any

import pytest

from orchestrator.domain.resources import Resources
from orchestrator.persistence.gangs import Gangs


def properties(nodes: int) -> dict[str, Any]:
    container = {"command": ["x"], "resourceRequirements": [{"type": "VCPU", "value": "2"}]}
    ranges = [{"targetNodes": "0:", "container": container}]
    return {"numNodes": nodes, "mainNode": 0, "nodeRangeProperties": ranges}


def test_a_definition_is_read_once_however_often_its_row_is_loaded_until_the_row_changes() -> None:
    gangs = Gangs()
    first = gangs.of("j", properties(3))
    assert first.shape.nodes == (Resources(2, 0, 4),) * 3
    assert gangs.of("j", properties(3)) is first, "an equal document, decoded anew"
    with pytest.raises(ValueError, match="the job's row in the database is damaged"):
        gangs.of("j", {})
    assert len(gangs.of("j", properties(2)).nodes) == 2


def test_only_the_definitions_used_last_are_remembered() -> None:
    gangs = Gangs(most=2)
    a, b = gangs.of("a", properties(1)), gangs.of("b", properties(1))
    assert gangs.of("a", properties(1)) is a
    gangs.of("c", properties(1))
    assert gangs.of("a", properties(1)) is a
    assert gangs.of("b", properties(1)) is not b
