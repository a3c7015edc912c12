"""An outcome file may have been written by the job itself: what is read of it is typed and bounded."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pytest

from shared_store.contract.faults import Fault
from shared_store.volume import node_outcomes
from shared_store.volume.layout import Run

ERROR = node_outcomes.FirstError(rank=0, message="broke", traceback="Traceback …", time=1e9)
OUTCOME = node_outcomes.Outcome(0, 1, 3, "SIGKILL", "reason", ERROR, 1e9, 1e9)


def test_long_texts_are_cut_where_they_are_written_and_say_how_much_is_missing(tmp_path: Path) -> None:
    run, long = Run(tmp_path), "begin " + "x" * 10_000_000 + " end"
    error = replace(ERROR, message=long, traceback=long)
    node_outcomes.write_outcome(run, "job", 1, replace(OUTCOME, reason=long, error=error))
    assert run.outcome("job", 1, 0).stat().st_size < 4 * node_outcomes.LONGEST_TEXT
    outcome = node_outcomes.read_outcome(run, "job", 1, 0)
    assert outcome and outcome.error and outcome == node_outcomes.bounded(outcome)
    assert outcome.reason == outcome.error.message
    assert outcome.reason.startswith("begin x") and outcome.reason.endswith("x … (9983690 characters left out)")
    traceback = outcome.error.traceback
    assert traceback.startswith("(9983690 characters left out) …") and traceback.endswith(" end")
    assert max(len(outcome.reason), len(traceback)) <= node_outcomes.LONGEST_TEXT


@pytest.mark.parametrize("fault", [None, Fault("ValueError", "reward.py", 3)])
def test_an_outcome_comes_back_with_its_fault(tmp_path: Path, fault: Fault | None) -> None:
    error = replace(ERROR, fault=fault)
    node_outcomes.write_outcome(Run(tmp_path), "job", 1, replace(OUTCOME, error=error))
    assert node_outcomes.read_outcome(Run(tmp_path), "job", 1, 0) == replace(OUTCOME, error=error)


WRONG: list[dict[str, Any]] = [
    *({"exit_code": each} for each in (10**30, -1, 256, "1", True)),
    *({"ended": -1e300}, {"ended": 1e300}, {"started": None}, {"reason": ["x"]}, {"cannot_start": 1}),
    {"error": {"rank": 0, "message": "m", "traceback": "", "time": 1e300}},
    {"error": {"rank": 0, "message": "m", "traceback": "", "time": 1.0, "fault": "x"}},
    {"error": {"rank": 0, "message": "m", "traceback": "", "time": 1.0, "fault": {"type": "x"}}},
    *({"error": [1]}, {"error": "x"}, {"other": 1}, {"requested": 1}),
]


@pytest.mark.parametrize("change", WRONG)
def test_an_outcome_of_other_types_or_sizes_is_none(tmp_path: Path, change: dict[str, Any]) -> None:
    path = Run(tmp_path).outcome("job", 1, 0)
    path.parent.mkdir(parents=True)
    path.write_text(json.dumps({**asdict(OUTCOME), **change}))
    assert node_outcomes.read_outcome(Run(tmp_path), "job", 1, 0) is None


def test_an_outcome_is_read_as_it_was_written_and_so_is_one_of_an_older_version() -> None:
    requested = replace(OUTCOME, requested=True)
    written = asdict(requested)
    assert node_outcomes.parse_outcome(written) == requested
    written["asked"] = written.pop("requested")
    assert node_outcomes.parse_outcome(written) == requested
    del written["asked"]
    assert node_outcomes.parse_outcome(written) == OUTCOME
