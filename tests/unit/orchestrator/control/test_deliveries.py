"""Which checkpoint and evaluation a message about a job tells of."""

from __future__ import annotations

import json
from pathlib import Path

from orchestrator.control.deliveries import _evaluated
from orchestrator.control.webhooks import run_of
from shared_store.files import write_json
from shared_store.layout import Store
from tests.support.orchestrator.rows import job
from tests.support.orchestrator.trained import add_checkpoint, add_run


def test_an_evaluation_tells_of_itself_and_a_training_of_its_newest_checkpoint(tmp_path: Path) -> None:
    store = Store(tmp_path)
    add_run(store, "taught")
    for iteration in (3, 6):
        add_checkpoint(store, "taught", iteration)
    run = store.run("taught")
    figures = {"mean_length": 9.0, "max_length": 10, "episodes": 4, "time": 1.0}
    write_json(run.evaluations / "00000003-e1-1f2e3d4c.json", {**figures, "mean_return": 3.0})
    write_json(run.evaluations / "00000006-e1.json", {**figures, "mean_return": 6.0})

    def told(job_id: str, spec: dict[str, object]) -> tuple[str | None, float | None]:
        environment = [{"name": "MUSTER_SPEC", "value": json.dumps(spec)}]
        ranges = [{"targetNodes": "0:", "container": {"environment": environment}}]
        properties = {"numNodes": 1, "mainNode": 0, "nodeRangeProperties": ranges}
        about = job(job_id, run="taught" if "train" in spec else "evaluate-taught", node_properties=properties)
        assert run_of(about) == "taught"
        checkpoint, summary = _evaluated(run, about)
        return checkpoint, summary and summary["mean_return"]

    assert told("1f2e3d4c-5b6a", {"evaluate": {"run": "taught"}}) == ("00000003-e1", 3.0)
    assert told("99999999-5b6a", {"evaluate": {"run": "taught"}}) == (None, None), "it failed before it had one"
    assert told("99999999-5b6a", {"train": {"task": "Cartpole"}}) == ("00000006-e1", 6.0)
