"""The initial weights of a clone: the run holds a copy of them, so the source may change or be deleted.

``parent/<checkpoint>/`` of the run has the ``learner.pt`` of the source's checkpoint and a manifest of that file alone;
``parent`` in ``run.json`` names their origin. The copy is made before the run exists, under a hidden name among the runs,
and appears with ``run.json`` by one rename.

A run that imitates a teacher holds a copy of the teacher's weights in the same way: ``teachers/<run>/checkpoints/<checkpoint>/``.
"""

from __future__ import annotations

import os
import shutil
import threading
import uuid
from collections.abc import Mapping
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any, Self

from shared_store.volume.checkpoints import Checkpoint, DamagedCheckpoint, checkpoint_called
from shared_store.volume.files import (
    MANIFEST,
    DamagedFile,
    copy_file,
    difference_of,
    hidden_folder,
    make_directory,
    rename_new,
    sync_directory,
    write_json,
)
from shared_store.volume.layout import Run, Store

WEIGHTS = "learner.pt"
"""The file of a checkpoint with the learner's state; the others hold worlds and random generators."""
FACTS = ("score", "score_error", "score_episodes", "env_steps")
"""Numbers of the source's manifest to repeat in the lineage."""


class RunExists(Exception):
    """A run, or another file, of that name exists."""


class WeightsCopy:
    """An unfinished copy of the weights of ``source``, a checkpoint, under a hidden name among the runs.

    As a context manager it is closed at the end, and discarded after an error. Its methods wait for each other.

    Args:
        store: Store of the runs.
        owner: Owner of the hidden directory; the owner's next copy deletes leftovers of crashed ones.
        source: Checkpoint with the weights.
    """

    def __init__(self, store: Store, owner: str, source: Checkpoint) -> None:
        self._store, self._owner, self.source = store, owner, source
        self.job = str(uuid.uuid4())
        """Id of the job that it is made for."""
        self.hidden = store.path / "runs" / f".{owner}.{self.job.replace('-', '')[:12]}.clone"
        self._published: Path | None = None
        self._using = threading.RLock()
        self._folder = ExitStack()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *details: object) -> None:
        if kind is None:
            self.close()
        else:
            self.discard()

    def copy(self, place: str = "parent") -> None:
        """Copy the weights durably into directory ``place``, and verify them against the source's manifest.

        Raises:
            DamagedCheckpoint: The source is missing, truncated or altered.
            OSError: The volume is full or gone.
        """
        with self._using:
            manifest = self.source.manifest
            if WEIGHTS not in manifest["files"]:
                raise DamagedCheckpoint(f"checkpoint {self.source.name}: it has no {WEIGHTS}, and so no weights")
            leftovers = (self._store.path / "runs").glob(f".{self._owner}.*.clone")
            self._folder.enter_context(hidden_folder(self.hidden, leftovers))
            target = self.hidden / place / self.source.name
            make_directory(target, 2)
            entry = manifest["files"][WEIGHTS]
            try:
                copy_file(self.source.path / WEIGHTS, target / WEIGHTS)
            except (DamagedFile, FileNotFoundError, NotADirectoryError):
                why = difference_of(self.source.path, WEIGHTS, entry)
                raise DamagedCheckpoint(f"checkpoint {self.source.name}: {why}") from None
            write_json(target / MANIFEST, {**manifest, "files": {WEIGHTS: entry}})
            Checkpoint(target, self.source.iteration, self.source.epoch).verify()
            for each in (target, target.parent, self.hidden):
                sync_directory(each)

    def discard(self) -> None:
        """Delete the unfinished copy."""
        with self._using:
            with suppress(OSError):
                shutil.rmtree(self.hidden, ignore_errors=True)
                if self._published is not None:
                    os.rename(self._published, self.hidden)
            self.close()

    def close(self) -> None:
        """End the copy: no part of it has a hidden name any more."""
        with self._using:
            self._folder.close()


class NewRun(WeightsCopy):
    """An unfinished run that will begin with the weights of ``source``, a checkpoint of run ``parent``."""

    def __init__(self, store: Store, owner: str, parent: str, source: Checkpoint) -> None:
        super().__init__(store, owner, source)
        self._parent = parent

    @property
    def lineage(self) -> dict[str, Any]:
        """``parent`` of the new run's ``run.json``."""
        numbers = {name: self.source.manifest.get(name) for name in FACTS}
        return {
            "run": self._parent,
            "checkpoint": self.source.name,
            "iteration": self.source.iteration,
            **{name: value for name, value in numbers.items() if isinstance(value, int | float)},
        }

    def publish(self, name: str, description: Mapping[str, Any]) -> Run:
        """Publish it as run ``name`` with this ``run.json`` (and :attr:`lineage`), by one rename. Raises RunExists, OSError."""
        run = self._store.run(name)
        with self._using:
            write_json(self.hidden / "run.json", {**description, "parent": self.lineage})
            if os.path.lexists(run.path):
                raise RunExists
            try:
                rename_new(self.hidden, run.path)
            except FileExistsError:
                raise RunExists from None  # another controller was faster
            self._published = run.path
            sync_directory(run.path.parent)
        return run


class TeacherCopy(WeightsCopy):
    """A copy of the weights of a teacher, a checkpoint of run ``teacher``, for a run that will imitate it."""

    def __init__(self, store: Store, owner: str, teacher: str, source: Checkpoint) -> None:
        super().__init__(store, owner, source)
        self.teacher = teacher

    def publish(self, run: Path) -> None:
        """Move it to the run in directory ``run``, by one rename. Raises DamagedFile, OSError."""
        with self._using:
            existing = Run(run)
            existing.check_links()
            place = existing.teacher(self.teacher).checkpoints
            target = place / self.source.name
            if not target.exists():
                make_directory(place, 4)
                os.rename(self.hidden / "teacher" / self.source.name, target)
                self._published = target
                for each in (place, *place.parents[:4]):
                    sync_directory(each)

    def discard(self) -> None:
        """Delete the copy and the directories that were created for it."""
        with self._using:
            super().discard()
            if self._published is not None:
                with suppress(OSError):  # not empty: it belongs to a run
                    for each in self._published.parents[:4]:
                        each.rmdir()


def parent_checkpoint(run: Run) -> Checkpoint | None:
    """The initial weights of ``run``, verified; None for a run that began with new ones.

    Raises:
        DamagedCheckpoint: They are missing, truncated or altered.
        DamagedFile, OSError: ``run.json`` can't be read.
    """
    found = named_parent(run)
    if found is not None:
        found.verify()
    return found


def named_parent(run: Run) -> Checkpoint | None:
    """As :func:`parent_checkpoint`, without verifying it."""
    lineage = (run.description() or {}).get("parent")
    if lineage is None:
        return None
    found = checkpoint_called(run.parent, str(lineage.get("checkpoint")))
    if found is None:
        raise DamagedCheckpoint(f"run {run.name}: run.json names no checkpoint as its parent")
    return found
