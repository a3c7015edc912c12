"""Shares of jobs that the command derives from a run: the controller gives them one."""

from __future__ import annotations

from typing import Any

import pytest

from orchestrator.cli import evaluations, recordings
from orchestrator.client import Client

TRAINED = {"name": "taught", "queue": "fair", "share": "ann", "train": {"task": "Cartpole", "worlds": 4}}


def test_a_job_beside_a_run_does_not_name_the_runs_share(monkeypatch: pytest.MonkeyPatch) -> None:
    answer: dict[str, Any] = {"run": "taught", "spec": TRAINED}
    monkeypatch.setattr(Client, "get", lambda self, path, **query: answer)
    with Client("http://127.0.0.1:1") as client:
        spec = evaluations._spec(client, "taught", "evaluate", None, {"episodes": 1}, [])
        assert (spec.queue, spec.share) == ("fair", None)
        recorded = recordings._common(answer, "record")
        assert recorded["queue"] == "fair" and "share" not in recorded
