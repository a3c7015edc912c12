"""What a job of an actor inherits of a run's spec: everything but the share of somebody else."""

from __future__ import annotations

from typing import Any

import pytest

from orchestrator.services.permissions import Actor
from orchestrator.services.spec_submission import inherited

SPEC: dict[str, Any] = {
    "queue": "fair",
    "share": "ann",
    "train": {"task": "Ant"},
    "evaluation": {"every": 2, "share": "ann"},
}


@pytest.mark.parametrize(
    ("share", "expected"),
    [
        (None, SPEC),
        ("ann", SPEC),
        ("bob", {"queue": "fair", "train": {"task": "Ant"}, "evaluation": {"every": 2, "share": None}}),
    ],
)
def test_a_keys_job_has_no_share_of_another(share: str | None, expected: dict[str, Any]) -> None:
    assert inherited(Actor("somebody", share=share), SPEC) == expected
    assert SPEC["share"] == "ann" and SPEC["evaluation"]["share"] == "ann", "the run's own spec stays"
