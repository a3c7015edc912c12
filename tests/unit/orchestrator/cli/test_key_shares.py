"""Jobs that the command derives from a run: with a key they leave the share to the key."""

from __future__ import annotations

from typing import Any

import pytest

from orchestrator.cli import evaluations, recordings
from orchestrator.client import Client

TRAINED = {"name": "taught", "queue": "fair", "share": "ann", "train": {"task": "Cartpole", "worlds": 4}}


@pytest.mark.parametrize(
    ("token", "share"), [("MSTR234567ABCDEFGHIJ:secret", None), ("a-token-for-tests-alone", "ann"), (None, "ann")]
)
def test_with_a_key_a_job_beside_a_run_does_not_name_the_runs_share(
    token: str | None, share: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    answer: dict[str, Any] = {"run": "taught", "spec": TRAINED}
    monkeypatch.setattr(Client, "get", lambda self, path, **query: answer)
    with Client("http://127.0.0.1:1", token) as client:
        spec = evaluations._spec(client, "taught", None, {"episodes": 1}, [], [], "evaluate")
        assert (spec.queue, spec.share) == ("fair", share)
        assert recordings._common(client, answer, "record").get("share") == share
