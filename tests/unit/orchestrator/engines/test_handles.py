"""Handles of gangs: one form in the database, and those that earlier versions wrote."""

from __future__ import annotations

import json
from typing import Any

import pytest

from orchestrator.engines.api import Handle, read_handle


def test_a_handle_is_read_as_it_was_written() -> None:
    facts = {"nodes": [{"pid": 7, "start": "123", "address": "127.64.0.1", "group": ""}]}
    handle = Handle("local", "job/1/2", 1, facts)
    assert json.loads(handle.text()) == {"engine": "local", "gang": "job/1/2", "nodes": 1, "facts": facts}
    assert read_handle(handle.text()) == handle and hash(read_handle(handle.text())) == hash(handle)
    assert read_handle(handle.text()) != Handle("local", "job/1/2", 1, {"nodes": []})


@pytest.mark.parametrize(
    ("engine", "told", "facts"),
    [
        ("local", {"gang": "job/1/2", "nodes": [{"pid": 7, "start": "1", "address": "a b"}]}, {"nodes"}),
        ("docker", {"gang": "job/1/2", "job": "job", "addresses": ["10.192.0.2"]}, {"job", "addresses"}),
        ("ray", {"ray": "job/1/2", "hosts": ["ray/n1"]}, {"hosts"}),
        ("slurm", {"gang": "job/1/2", "slurm": "17", "native": True, "output": "/a b"}, {"slurm", "native", "output"}),
        ("aws-batch", {"gang": "job/1/2", "aws": "0-1", "queue": "q"}, {"aws", "queue"}),
    ],
)
def test_a_handle_of_an_earlier_version_is_read(engine: str, told: dict[str, Any], facts: set[str]) -> None:
    found = read_handle(f"{engine} 3 {json.dumps(told)}")
    assert (found.engine, found.gang, found.nodes) == (engine, "job/1/2", 3)
    assert found.facts == {name: told[name] for name in facts}


@pytest.mark.parametrize("text", ["", "local", "local 3", "local x {}", "local 3 []", "{}", '{"engine": "local"}', "{"])
def test_a_damaged_handle_is_named(text: str) -> None:
    with pytest.raises(ValueError, match="the handle of a gang is damaged"):
        read_handle(text)
