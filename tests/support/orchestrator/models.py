"""Models in a registry, of runs that look trained."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from shared_store.contract.policy import Contract, Group, RobotModel
from shared_store.volume import models
from shared_store.volume.bundles import seal
from shared_store.volume.evaluations import evaluation_name
from shared_store.volume.files import read_json, write_json
from shared_store.volume.layout import Store
from shared_store.volume.models import Model
from tests.support.orchestrator.trained import SPEC, add_checkpoint, add_run

EVALUATION = {
    "mean_return": 100.0,
    "mean_length": 185.0,
    "max_length": 18_000,
    "episodes": 3,
    "time": 2000.0,
    "seed": 3,
}


def add_model(
    store: Store,
    name: str,
    run: str,
    iteration: int,
    queue: str = "default",
    *,
    train: dict[str, Any] = SPEC["train"],
    evaluation: dict[str, Any] = EVALUATION,
    parent: dict[str, Any] | None = None,
    pole: float | None = None,
    **facts: Any,
) -> Model:
    """The next version of a model, of a new checkpoint of a run, with one evaluation.

    Args:
        store: The store.
        name: Of the model.
        run: The run; it is made where it does not exist.
        iteration: Of the checkpoint.
        queue: To which run and model belong.
        train: Of the run's spec.
        evaluation: Its summary.
        parent: What the run is a clone of, where it is made here.
        pole: Mass of its robot's pole [kg], another one than in the training.
        facts: Further ones of the version.
    """
    if store.run(run).description() is None:
        add_run(store, run, {**SPEC, "name": run, "train": train}, queue)
        path = store.run(run).path / "run.json"
        write_json(path, {**(read_json(path) or {}), "parent": parent})
    task = train["task"]
    checkpoint = add_checkpoint(store, run, iteration, task=task, train=train)
    found = store.run(run).evaluations / f"{evaluation_name(checkpoint.name, 'job')}.json"
    write_json(found, {"task": task, "config": {}, "versions": {}, **evaluation})
    bundle = store.run(run).exports / checkpoint.name
    bundle.mkdir(parents=True)
    (bundle / "policy.onnx").write_bytes(b"weights")
    contract = Contract(task, "0.1.0", 15.0, (Group("policy", "policy", (8,), "float32"),), (), ("force", "brake"))
    if pole is not None:
        robot = RobotModel("robot", f"{pole:064}", 1.0 + pole, 2, 1, {"body pole": {"mass": pole}})
        contract = replace(contract, robots=(robot,))
        write_json(bundle / "report.json", {"changed_robot": f"trained on another robot: pole {pole:g} kg"})
    write_json(bundle / "contract.json", contract.document())
    seal(bundle, {"task": task, "train": train, "checkpoint_files": checkpoint.manifest["files"], "score": 3.5})
    return models.register(store, name, store.run(run), checkpoint, {"queue": queue, **facts})
