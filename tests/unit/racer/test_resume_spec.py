"""What may change of a racer's training, or of a race, that is resumed."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from orchestrator.domain.errors import ClientError
from orchestrator.services.resume import _check_changes
from orchestrator.spec.changes import override
from orchestrator.spec.model import validate
from shared_store.volume.layout import Run

RUN = Run(Path("/store/runs/ant"))
RACE: dict[str, Any] = {
    **{"run": "ant", "checkpoint": 3, "accept_changed_robot": True, "trials": 5, "continuous": True},
    **{"off_track_penalty": 5.0, "crash_penalty": 5.0, "max_resets": 3, "seconds": 60.0, "track": "chicane"},
    **{"seed": 3, "config": {"x": 1}, "keep": False},
}
"""Other values of the keys of a race, which its rank reads in the spec."""


@pytest.mark.parametrize("key", RACE)
def test_a_key_of_a_race_that_is_changed_is_in_the_job_that_goes_on(key: str) -> None:
    document = {"name": "final", "race": {"run": "other"}}
    before = validate(document, "run final")
    after = validate(override(document, [f"race.{key}={json.dumps(RACE[key])}"]), "run final", merged=False)
    _check_changes(RUN, before, after)
    race: Any = after
    assert type(race.race).model_fields.keys() == RACE.keys()
    assert before.document()["race"].get(key) != after.document()["race"][key] == RACE[key]


def test_a_setting_of_the_task_that_changes_nothing_of_the_training_may_change() -> None:
    racer = {"task": "Racer", "worlds": 8, "iterations": 2, "config": {"track": "oval"}}
    before, traced, elsewhere = (
        validate({"name": "car", "train": {**racer, "config": {"track": track, **more}}}, "job.yaml")
        for track, more in (("oval", {}), ("oval", {"sim_trace": 4}), ("chicane", {"sim_trace": 4}))
    )
    _check_changes(RUN, before, traced)
    _check_changes(RUN, traced, before)
    with pytest.raises(ClientError, match=r"train\.config\.track is 'oval' and can't become 'chicane'"):
        _check_changes(RUN, before, elsewhere)
