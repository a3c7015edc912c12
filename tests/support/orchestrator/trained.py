"""A run that looks trained to whoever does not load its weights: spec, manifests and files with digests, in a store."""

from __future__ import annotations

from typing import Any

from shared_store.volume.checkpoints import Checkpoint, CheckpointWriter
from shared_store.volume.epoch import raise_epoch, read_epoch
from shared_store.volume.files import write_json
from shared_store.volume.layout import Store

SPEC: dict[str, Any] = {
    "name": "taught",
    "resources": {"cpus": 1, "memory": 64},
    "train": {"task": "Cartpole", "worlds": 4, "iterations": 9, "ppo": {"hidden_sizes": [8]}},
}
SETTINGS = {"hidden_sizes": [8], "optimizer": "adam", "activation": "elu", "learning_rate": 1e-3}


def add_run(store: Store, name: str, spec: dict[str, Any] | None = SPEC, queue: str = "default") -> None:
    """Run ``name``, without a checkpoint."""
    facts = {"run": name, "created": 1, "spec": spec, "queue": queue, "owner": "ann"}
    write_json(store.run(name).path / "run.json", facts, levels=2)


def add_checkpoint(store: Store, name: str, iteration: int, weights: bytes = b"weights", **facts: Any) -> Checkpoint:
    """A checkpoint of run ``name``, whose ``learner.pt`` holds ``weights``."""
    run = store.run(name)
    raise_epoch(run, 1) if read_epoch(run) < 1 else None
    writer = CheckpointWriter(run, iteration, 1)
    (writer.path / "learner.pt").write_bytes(weights)
    (writer.path / "rank-0.pt").write_bytes(b"worlds")
    known = {"algorithm": "ppo", "settings": SETTINGS, "task": "Cartpole", "worlds": 4, "reward": 1.0}
    return writer.commit({**known, **facts})
