"""The section ``race`` of the job YAML: what is wrong with it is told in one line, with file, line and key."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from orchestrator.domain.errors import SpecError
from orchestrator.spec.file import load
from orchestrator.spec.model import validate
from orchestrator.spec.values import known_tasks
from tests.support.refusals import refusal

WRONG = {
    "race: {laps: 3}": (
        ":2: race.laps: unknown key; valid here: run, checkpoint, accept_changed_robot, trials, continuous, off_track_penalty, "
        "crash_penalty, max_resets, seconds, track, seed, config, keep (and 1 more)"
    ),
    "race: {run: x, trials: 101}": ":2: race.trials: expected a value less than or equal to 100, found 101",
    "nodes: 2\nrace: {run: x}": ": race: it runs on one node with at most one GPU",
}


@pytest.mark.parametrize("text", WRONG)
def test_what_is_wrong_is_told_with_its_line(tmp_path: Path, text: str) -> None:
    path = tmp_path / "job.yaml"
    path.write_text(f"name: a\n{text}\n")
    assert refusal(load, str(path), error=SpecError) == f"{path}{WRONG[text]}"


def test_the_racers_tasks_are_known_by_name() -> None:
    assert {"Racer", "RacerPixels", "RacerPixelsAndState"} <= set(known_tasks())


def test_a_checkpoint_is_named_as_every_kind_of_job_names_it() -> None:
    for expected in (3, "best", "latest"):
        found: Any = validate({"name": "a", "race": {"run": "x", "checkpoint": expected}}, "job.yaml")
        assert found.race.checkpoint == expected
    with pytest.raises(SpecError, match=r"^job\.yaml: race\.checkpoint: expected an iteration, best or latest"):
        validate({"name": "a", "race": {"run": "x", "checkpoint": "newest"}}, "job.yaml")
