"""The weights with which a clone begins: the run holds a copy of them, so that nothing which befalls the source matters to it.

``parent/<checkpoint>/`` of the run has the ``learner.pt`` of the source's checkpoint and a manifest of that file alone;
``parent`` in ``run.json`` says where they come from. The copy is made before the run exists, under a hidden name among the runs,
and appears with ``run.json`` by one rename.
"""

from __future__ import annotations

import errno
import os
import shutil
import uuid
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from shared_store.checkpoints import Checkpoint, DamagedCheckpoint, checkpoint_called
from shared_store.files import DamagedFile, open_regular, sync_directory, write_json
from shared_store.layout import Run, Store

WEIGHTS = "learner.pt"
"""The file of a checkpoint that holds what was learnt; the others hold worlds and generators."""
FACTS = ("score", "score_error", "score_episodes", "env_steps")
"""Numbers of the source's manifest that the lineage repeats."""


class RunExists(Exception):
    """There is a run, or something else, of that name."""


class NewRun:
    """A run in the making that will begin with the weights of ``source``, a checkpoint of run ``parent``.

    Args:
        store: Where both runs are.
        owner: Of the hidden directory; the next run that the same owner makes clears away what a crash left of earlier ones.
    """

    _in_progress: set[Path] = set()

    def __init__(self, store: Store, owner: str, parent: str, source: Checkpoint) -> None:
        self._store, self._owner, self._parent, self._source = store, owner, parent, source
        self._hidden = store.path / "runs" / f".{owner}.{uuid.uuid4().hex[:12]}.clone"
        self._published: Path | None = None

    def copy(self) -> None:
        """Copy the weights, durably, and prove that they are what the source's manifest says.

        Raises:
            DamagedCheckpoint: The source is missing, truncated or altered.
            OSError: The volume is full or gone.
        """
        manifest = self._source.manifest
        if WEIGHTS not in manifest["files"]:
            raise DamagedCheckpoint(
                f"checkpoint {self._source.name}: it has no {WEIGHTS}, so there are no weights in it"
            )
        self._in_progress.add(self._hidden)
        self._clear_leftovers()
        target = self._hidden / "parent" / self._source.name
        target.mkdir(parents=True)
        try:
            with open_regular(self._source.path / WEIGHTS) as there, open(target / WEIGHTS, "wb") as here:
                shutil.copyfileobj(there, here, 1 << 20)
                here.flush()
                os.fsync(here.fileno())
        except DamagedFile:
            raise DamagedCheckpoint(f"checkpoint {self._source.name}: {WEIGHTS} is not a regular file") from None
        except (FileNotFoundError, NotADirectoryError):
            raise DamagedCheckpoint(f"checkpoint {self._source.name}: {WEIGHTS} is missing") from None
        write_json(target / "manifest.json", {**manifest, "files": {WEIGHTS: manifest["files"][WEIGHTS]}})
        Checkpoint(target, self._source.iteration, self._source.epoch).verify()
        for each in (target, target.parent, self._hidden):
            sync_directory(each)

    @property
    def lineage(self) -> dict[str, Any]:
        """``parent`` of the new run's ``run.json``."""
        numbers = {name: self._source.manifest.get(name) for name in FACTS}
        return {
            "run": self._parent,
            "checkpoint": self._source.name,
            "iteration": self._source.iteration,
            **{name: value for name, value in numbers.items() if isinstance(value, int | float)},
        }

    def publish(self, name: str, description: Mapping[str, Any]) -> Run:
        """Make it the run ``name`` with this ``run.json`` (and :attr:`lineage`), by one rename. Raises RunExists, OSError."""
        run = self._store.run(name)
        write_json(self._hidden / "run.json", {**description, "parent": self.lineage})
        if os.path.lexists(run.path):
            raise RunExists
        try:
            os.rename(self._hidden, run.path)
        except OSError as error:
            if error.errno in (errno.EEXIST, errno.ENOTEMPTY, errno.ENOTDIR):
                raise RunExists from None  # another controller was faster
            raise
        self._published = run.path
        sync_directory(run.path.parent)
        return run

    def discard(self) -> None:
        """Take back what was made, where it came to nothing."""
        with suppress(OSError):
            shutil.rmtree(self._hidden, ignore_errors=True)
            if self._published is not None:
                os.rename(self._published, self._hidden)
                shutil.rmtree(self._hidden, ignore_errors=True)
        self.close()

    def close(self) -> None:
        """Nothing of it is under a hidden name any more."""
        self._in_progress.discard(self._hidden)

    def _clear_leftovers(self) -> None:
        with suppress(OSError):
            for path in (self._store.path / "runs").glob(f".{self._owner}.*.clone"):
                if path not in self._in_progress:
                    shutil.rmtree(path, ignore_errors=True)


def parent_checkpoint(run: Run) -> Checkpoint | None:
    """The weights with which ``run`` began, verified; None for a run that began with new ones.

    Raises:
        DamagedCheckpoint: They are missing, truncated or altered.
        DamagedFile, OSError: ``run.json`` can't be read.
    """
    lineage = (run.description() or {}).get("parent")
    if lineage is None:
        return None
    found = checkpoint_called(run.parent, str(lineage.get("checkpoint")))
    if found is None:
        raise DamagedCheckpoint(f"run {run.name}: run.json names no checkpoint as its parent")
    found.verify()
    return found
