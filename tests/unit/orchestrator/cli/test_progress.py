"""The progress of a training, as plain lines and as a bar."""

from __future__ import annotations

from typing import Any

import pytest

from orchestrator.cli.progress import _Bar, _Lines

DETAIL: dict[str, Any] = {
    "spec": {"train": {"iterations": 9}},
    "nodes": 1,
    "name": "cart",
    "id": "0" * 36,
    "run": "cart-1",
}
RECORD = {"iteration": 3, "reward": 1.0, "time": 1.0, "warnings": ["it unlearns: (RUN@best)"]}


def test_a_warning_names_the_run(capsys: pytest.CaptureFixture[str]) -> None:
    lines = _Lines(DETAIL)
    lines.show({"status": "RUNNING"}, RECORD)
    assert capsys.readouterr().out.endswith("\nwarning: it unlearns: (cart-1@best)\n")
    bar = _Bar(DETAIL)
    bar.show({"status": "RUNNING"}, RECORD)
    assert bar._progress.tasks[0].fields["text"].endswith("  warning: it unlearns: (cart-1@best)")
