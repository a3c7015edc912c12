"""A store with models of racers and a league, as pages show them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from racer.store import leagues
from shared_store.contract.policy import Contract, Group, RobotModel
from shared_store.volume import models
from shared_store.volume.bundles import seal
from shared_store.volume.evaluations import evaluation_name
from shared_store.volume.files import read_json, write_json
from shared_store.volume.layout import Store
from shared_store.volume.models import Model
from tests.support.orchestrator.trained import SPEC, add_checkpoint, add_run
from tests.support.racer.leagues import entry, league, race, summary

TRAIN = {"task": "Racer", "worlds": 4, "iterations": 9}


def add_racer(store: Store, name: str, run: str, iteration: int, queue: str = "default", **facts: Any) -> Model:
    """The next version of a model, of a new checkpoint of a run, with one evaluation.

    ``parent``: what the run is a clone of, where it is made here. ``pole``: mass of its robot's pole [kg], another one than in the training.
    """
    parent, pole = facts.pop("parent", None), facts.pop("pole", None)
    if store.run(run).description() is None:
        add_run(store, run, {**SPEC, "name": run, "train": TRAIN}, queue)
        path = store.run(run).path / "run.json"
        write_json(path, {**(read_json(path) or {}), "parent": parent})
    checkpoint = add_checkpoint(store, run, iteration, task="Racer", train=TRAIN)
    found = summary(race([12.0, 12.5, 13.0]), seed=3, config={})
    write_json(store.run(run).evaluations / f"{evaluation_name(checkpoint.name, 'job')}.json", found)
    bundle = store.run(run).exports / checkpoint.name
    bundle.mkdir(parents=True)
    (bundle / "policy.onnx").write_bytes(b"weights")
    contract = Contract(
        "Racer", "0.1.0", 15.0, (Group("policy", "policy", (8,), "float32"),), (), ("steering", "speed")
    )
    if pole is not None:
        robot = RobotModel("robot", f"{pole:064}", 1.0 + pole, 2, 1, {"body pole": {"mass": pole}})
        contract = replace(contract, robots=(robot,))
        write_json(bundle / "report.json", {"changed_robot": f"trained on another robot: pole {pole:g} kg"})
    write_json(bundle / "contract.json", contract.document())
    seal(bundle, {"task": "Racer", "train": TRAIN, "checkpoint_files": checkpoint.manifest["files"], "score": 3.5})
    return models.register(store, name, store.run(run), checkpoint, {"queue": queue, **facts})


def add_league(store: Store, name: str = "cup", *racers: str) -> None:
    """A league with an entry of each racer."""
    stored = leagues.create(store, league(name))
    for version, racer in enumerate(racers, 1):
        stored.enter(entry(racer, version=version))
