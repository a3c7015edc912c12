"""A clone as a controller makes it, without a controller."""

from __future__ import annotations

from pathlib import Path

from shared_store.volume.checkpoints import Checkpoint, list_checkpoints
from shared_store.volume.initial_weights import NewRun
from shared_store.volume.layout import Run, Store


def make_clone(store: Path, name: str, source: str = "run", checkpoint: Checkpoint | None = None) -> Run:
    """Run ``name``, which begins with the weights of a checkpoint (by default the newest) of run ``source``."""
    opened = Store(store)
    making = NewRun(opened, "test", source, checkpoint or list_checkpoints(opened.run(source))[-1])
    making.copy()
    run = making.publish(name, {"run": name, "created": 0, "spec": None})
    making.close()
    return run
