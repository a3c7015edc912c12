"""Checks of a gang that is submitted: the edges of what is taken."""

from __future__ import annotations

import json

import pytest

from orchestrator.domain.errors import ClientError
from orchestrator.domain.gang import gang_needs
from orchestrator.domain.gang_checks import LARGEST_ENVIRONMENT, MOST_VARIABLES, checked_gang
from orchestrator.domain.storable import DEEPEST_SPEC
from shared_store.contract.node import LEAST_LOG_LIMIT
from tests.support.definitions import container, nodes_of
from tests.support.refusals import refusal


def nested(levels: int) -> str:
    """A mapping of so many levels."""
    return '{"a":' * (levels - 1) + "{}" + "}" * (levels - 1)


TAKEN: dict[str, dict[str, str]] = {
    "nothing": {},
    "an empty value": {"A": ""},
    "as many as may be": {f"V{number}": "" for number in range(MOST_VARIABLES)},
    "as large as may be": {"A": "é" * ((LARGEST_ENVIRONMENT - 2) // 2), "B": ""},
    "as deep as may be": {"MUSTER_SPEC": nested(DEEPEST_SPEC)},
    "no spec": {"MUSTER_SPEC": "null"},
    "a whole character": {"MUSTER_SPEC": json.dumps({"name": "🤖"})},
    "the least log": {"MUSTER_LOG_LIMIT": str(LEAST_LOG_LIMIT)},
    "the least nodes": {"MUSTER_MIN_NODES": "-1"},
    "a policy": {"MUSTER_ON_CHILD_FAILURE": "fail"},
}
REFUSED: dict[str, dict[str, str]] = {
    "one too many": {f"V{number}": "" for number in range(MOST_VARIABLES + 1)},
    "a byte too large": {"A": "x" * LARGEST_ENVIRONMENT},
    "a level too deep": {"MUSTER_SPEC": nested(DEEPEST_SPEC + 1)},
    "half of a character": {"MUSTER_SPEC": r'{"name": "\ud83e"}'},
    "half of a character in a value": {"A": "\ud83e"},
    "a text for a spec": {"MUSTER_SPEC": '"ant"'},
    "too small a log": {"MUSTER_LOG_LIMIT": str(LEAST_LOG_LIMIT - 1)},
    "too large a log": {"MUSTER_LOG_LIMIT": str(2**63)},
    "no time": {"MUSTER_STALL_TIMEOUT": "0"},
    "time without an end": {"MUSTER_STALL_TIMEOUT": "inf"},
    "a number of nodes with many digits": {"MUSTER_MIN_NODES": "9" * 5000},
}


@pytest.mark.parametrize("case", TAKEN)
def test_a_gang_at_the_edge_is_taken_as_it_is_read(case: str) -> None:
    properties = nodes_of(container(env=TAKEN[case]), 2)
    assert checked_gang(properties) == gang_needs(properties)


@pytest.mark.parametrize("case", REFUSED)
def test_a_gang_behind_the_edge_is_refused_in_one_line(case: str) -> None:
    words = refusal(checked_gang, nodes_of(container(env=REFUSED[case]), 2), error=ClientError)
    assert 0 < len(words) < 300


@pytest.mark.parametrize("text", [nested(DEEPEST_SPEC + 1), "[" * 100_000, r'{"a": "\ud83e"}', "[]", "{"])
def test_a_stored_spec_that_no_answer_could_show_is_a_damaged_row(text: str) -> None:
    gang = gang_needs(nodes_of(container(env={"MUSTER_SPEC": text})))
    with pytest.raises(ValueError, match="MUSTER_SPEC"):
        _ = gang.spec
