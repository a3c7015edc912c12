"""Every path of ``worker`` on which ranks wait for one another is listed, with the test in which two real ranks take it."""

from __future__ import annotations

import ast
from pathlib import Path

from tests.support.worker.collectives import ALONE, TESTS, other_names, paths

GANGS = Path(__file__).parents[2] / "training" / "worker" / "test_gangs.py"


def test_every_path_that_enters_a_collective_is_listed_and_every_listed_one_is_there() -> None:
    existing = {call.function for call in paths()}
    assert existing - TESTS.keys() - ALONE.keys() == set(), "write a case in test_gangs.py"
    assert (TESTS.keys() | ALONE.keys()) - existing == set(), "these enter no collective any more"
    assert not TESTS.keys() & ALONE.keys()


def test_every_listed_test_is_there_and_has_a_case() -> None:
    functions = {node.name for node in ast.parse(GANGS.read_text()).body if isinstance(node, ast.FunctionDef)}
    for name in TESTS.values():
        assert {name, name.removeprefix("test_")} <= functions, name


def test_a_gang_is_known_by_its_name_everywhere() -> None:
    assert other_names() == []
