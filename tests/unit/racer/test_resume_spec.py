"""What may change of a racer's training that is resumed."""

from __future__ import annotations

from pathlib import Path

import pytest

from orchestrator.domain.errors import ClientError
from orchestrator.services.resume import _check_changes
from orchestrator.spec.model import validate
from shared_store.volume.layout import Run

RUN = Run(Path("/store/runs/ant"))


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
