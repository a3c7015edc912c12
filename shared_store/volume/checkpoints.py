"""Checkpoints: committed atomically, verified when they are read, never written twice.

``checkpoints/<iteration, 8 digits>-e<epoch>/`` holds ``manifest.json`` and the files that it lists with size and SHA-256. The
directory appears by a rename, after everything in it is durable. ``LATEST`` is a hint for people; the truth is the listing.
"""

from __future__ import annotations

import contextlib
import math
import os
import re
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import chain, count
from pathlib import Path
from typing import Any

from shared_store.volume.epoch import StaleEpoch, check_epoch
from shared_store.volume.evaluations import by_checkpoint, kept_checkpoints
from shared_store.volume.files import (
    MANIFEST,
    difference_of,
    manifest_entry,
    read_manifest,
    remove_tree,
    sync_directory,
    write_atomic,
    write_json,
)
from shared_store.volume.layout import Run

FORMAT = 1
_NAME = re.compile(r"([0-9]{8})-e([0-9]{1,18})")
_MAKING = re.compile(r"\.([0-9]{8})-e([0-9]{1,18})\.tmp")
_FILE = re.compile(r"[A-Za-z0-9_][A-Za-z0-9._-]{0,199}")
"""Valid names of a checkpoint's files: none leads out of it."""


class DamagedCheckpoint(Exception):
    """A checkpoint can't be used; the message names it, the file and the error."""


class NewerFormat(DamagedCheckpoint):
    """A newer Muster wrote the checkpoint: it is not damaged, so it must not be set aside."""


@dataclass(frozen=True)
class Checkpoint:
    """A committed checkpoint. ``iteration`` is the number of finished iterations."""

    path: Path
    iteration: int
    epoch: int

    @property
    def name(self) -> str:
        return self.path.name

    @cached_property
    def manifest(self) -> dict[str, Any]:
        """The content of ``manifest.json``. Raises DamagedCheckpoint if it can't be read."""
        called = f"checkpoint {self.name}: "
        manifest = read_manifest(
            self.path, _FILE, FORMAT, lambda why: DamagedCheckpoint(called + why), lambda why: NewerFormat(called + why)
        )
        for key in ("created", "reward", "score", "score_error", "worlds", "world_size"):
            if isinstance(manifest.get(key), str | list | dict):
                raise DamagedCheckpoint(f"{called}{MANIFEST}: {key} is not a number")
        return manifest

    @property
    def size(self) -> int:
        """Bytes of all the files that the manifest lists."""
        return sum(entry["size"] for entry in self.manifest["files"].values())

    @property
    def is_scheduled(self) -> bool:
        """Whether the job asked for it; False if it was saved only because its iterations are long (:mod:`worker.learning.leaving`)."""
        with contextlib.suppress(DamagedCheckpoint):
            return self.manifest.get("scheduled") is not False
        return True

    def verify(self) -> None:
        """Raises DamagedCheckpoint, naming the first file that is missing, truncated or altered."""
        for name, entry in sorted(self.manifest["files"].items()):
            if problem := difference_of(self.path, name, entry):
                raise DamagedCheckpoint(f"checkpoint {self.name}: {problem}")


def checkpoint_called(directory: Path, name: str) -> Checkpoint | None:
    """The checkpoint of that name in ``directory``, whether it exists or not; None for an invalid name."""
    match = _NAME.fullmatch(name)
    return Checkpoint(directory / match[0], int(match[1]), int(match[2])) if match else None


def list_checkpoints(run: Run) -> list[Checkpoint]:
    """Every committed checkpoint, the newest last.

    A later epoch is newer whatever its iteration: each attempt starts from the newest checkpoint before it, unless a person
    chose an older one; then the later history counts.
    """
    try:
        entries = os.listdir(run.checkpoints)
    except (FileNotFoundError, NotADirectoryError):
        return []
    found = filter(None, (checkpoint_called(run.checkpoints, entry) for entry in entries))
    return sorted(found, key=lambda checkpoint: (checkpoint.epoch, checkpoint.iteration))


def newest_checkpoint(
    run: Run,
    *,
    chosen: str | None = None,
    chosen_since: int = 0,
    damaged: Callable[[Checkpoint, DamagedCheckpoint], None] | None = None,
) -> Checkpoint | None:
    """The checkpoint from which an attempt resumes: the newest one that verifies; None without any.

    Args:
        run: The run.
        chosen: Name of the checkpoint that a person chose. The choice holds until the job has committed a checkpoint of its
            own, that is, of epoch ``chosen_since`` or later.
        chosen_since: Epoch of that job's first attempt.
        damaged: Called for each newer checkpoint that does not verify (to report it and to set it aside).

    Raises:
        DamagedCheckpoint: The chosen one is missing or does not verify; no other replaces a person's choice.
    """
    checkpoints = list_checkpoints(run)
    for checkpoint in reversed(checkpoints):
        if chosen is not None and checkpoint.epoch < chosen_since:
            break
        try:
            checkpoint.verify()
            return checkpoint
        except DamagedCheckpoint as error:
            if damaged:
                damaged(checkpoint, error)
    if chosen is None:
        return None
    found = next((checkpoint for checkpoint in checkpoints if checkpoint.name == chosen), None)
    if found is None:
        raise DamagedCheckpoint(f"checkpoint {chosen}: not in run {run.name}")
    found.verify()
    return found


def best_checkpoint(run: Run) -> Checkpoint | None:
    """The best checkpoint, of equals the later; None if none has an evaluation or a score yet.

    If two or more existing checkpoints have been evaluated in the worlds of their training, it is the one with the greatest mean return.
    Otherwise it is the one with the greatest score, which is a mean over many episodes of the training, not the reward of the single
    iteration before the checkpoint.
    """
    checkpoints = list_checkpoints(run)
    evaluated = by_checkpoint(run)
    if len(evaluated) > 1 and (judged := best_evaluated(checkpoints, evaluated)):
        return judged
    scored = [(score, c) for c in reversed(checkpoints) if (score := _score(c, "score")) is not None]
    return max(scored, key=lambda pair: pair[0], default=(0.0, None))[1]


def best_evaluated(checkpoints: Sequence[Checkpoint], evaluated: Mapping[str, Mapping[str, Any]]) -> Checkpoint | None:
    """The evaluated checkpoint with the greatest mean return, of equals the later; None if none is evaluated.

    Args:
        checkpoints: The newest last.
        evaluated: From :func:`shared_store.volume.evaluations.by_checkpoint`.
    """
    judged = [checkpoint for checkpoint in reversed(checkpoints) if checkpoint.name in evaluated]
    return max(judged, key=lambda checkpoint: float(evaluated[checkpoint.name]["mean_return"]), default=None)


def set_aside(checkpoint: Checkpoint) -> Path:
    """Take a damaged checkpoint out of the listing without deleting it; returns its new path."""
    suffixes = chain((".damaged",), (f".damaged-{number}" for number in count(2)))
    names = (checkpoint.path.with_name(f"{checkpoint.name}{suffix}") for suffix in suffixes)
    target = next(path for path in names if not path.exists())
    os.rename(checkpoint.path, target)
    sync_directory(target.parent)
    return target


def sweep(run: Run, up_to: tuple[int, int] | None = None) -> list[str]:
    """Delete the leftovers of interrupted commits and deletions; returns their names. For the newest epoch's main rank only.

    ``up_to``: epoch and iteration of a checkpoint; unfinished ones after it are left alone.
    """
    swept = []
    for entry in os.listdir(run.checkpoints) if run.checkpoints.exists() else []:
        making = _MAKING.fullmatch(entry)
        if up_to and making and (int(making[2]), int(making[1])) > up_to:
            continue
        if entry.startswith(".") and entry.endswith((".tmp", ".trash")):
            path = run.checkpoints / entry
            if path.is_dir():
                remove_tree(path)
            else:
                path.unlink(missing_ok=True)
            swept.append(entry)
    return swept


class CheckpointWriter:
    """An unfinished checkpoint: every rank durably writes its own files into ``path``, then the main rank commits."""

    def __init__(self, run: Run, iteration: int, epoch: int) -> None:
        self.run, self.iteration, self.epoch = run, iteration, epoch
        self.name = f"{iteration:08d}-e{epoch}"
        self.path = run.checkpoints / f".{self.name}.tmp"
        run.checkpoints.mkdir(exist_ok=True)  # not its parents: a deleted run must not come back in part
        self.path.mkdir(exist_ok=True)

    def commit(
        self, facts: Mapping[str, Any], keep: int | None = None, digests: Mapping[str, Any] | None = None
    ) -> Checkpoint:
        """Publish the checkpoint: manifest, fsync, fence, rename, ``LATEST``, retention. Main rank only, after all files.

        A writer that was killed after the rename, or whose volume failed then, has published it already: that one stands.

        Args:
            facts: Further entries of the manifest (world size, worlds, reward, versions); JSON values.
            keep: Number of the newest checkpoints to keep; None keeps all. The best by ``score`` is always kept.
            digests: ``{name: {"size", "sha256"}}`` of every file, from its writer; None: read the files back.

        Raises:
            StaleEpoch: A newer attempt owns the run; nothing was published.
            OSError: The volume is full or gone; the last checkpoint remains valid.
        """
        target = self.run.checkpoints / self.name
        if not (stands := target.exists()):
            self._write_manifest(facts, digests)
        check_epoch(self.run, self.epoch)
        if not stands:
            os.rename(self.path, target)
        sync_directory(self.run.checkpoints)
        # The checkpoint is committed. A failure from here on costs a hint or space, and an attempt that was frozen in the rename
        # must not prune its successor's checkpoints.
        with contextlib.suppress(OSError, StaleEpoch):
            check_epoch(self.run, self.epoch)
            if keep is not None:
                retain(self.run, keep)
            # every rank's writer takes its saves in order: no rank still works on an earlier, failed one
            sweep(self.run, up_to=(self.epoch, self.iteration))
            write_atomic(self.run.checkpoints / "LATEST", f"{self.name}\n".encode(), levels=0)
        return Checkpoint(target, self.iteration, self.epoch)

    def _write_manifest(self, facts: Mapping[str, Any], digests: Mapping[str, Any] | None) -> None:
        """The last file of the directory, in place of the notes that the ranks left for the main rank."""
        for notes in self.path.glob(".*"):
            notes.unlink()
        files = digests or {
            name: manifest_entry(self.path / name) for name in sorted(os.listdir(self.path)) if name != MANIFEST
        }
        manifest = {
            "format": FORMAT,
            "iteration": self.iteration,
            "epoch": self.epoch,
            "created": time.time(),
            "files": files,
        }
        write_json(self.path / MANIFEST, {**facts, **manifest}, levels=0)


def retain(run: Run, keep: int) -> list[str]:
    """Delete all but the newest ``keep`` scheduled checkpoints, the newest one of all, the one with the greatest ``score``, the best
    evaluated one, and those of finished or pending exports and of evaluations that keep their checkpoint; returns the deleted names.
    """
    checkpoints = list_checkpoints(run)
    scored = [(score, c.name) for c in checkpoints if (score := _score(c, "score", "reward")) is not None]
    scheduled = [c for c in checkpoints if c.is_scheduled]
    best = best_evaluated(checkpoints, by_checkpoint(run))
    kept = {c.name for c in (*scheduled[-max(1, keep) :], *checkpoints[-1:], *filter(None, (best,)))}
    kept |= {max(scored)[1]} if scored else set()
    kept |= kept_checkpoints(run) | {path.name for path in run.exports.glob("*")}
    deleted = [checkpoint for checkpoint in checkpoints if checkpoint.name not in kept]
    for checkpoint in deleted:
        remove_tree(checkpoint.path)
    return [checkpoint.name for checkpoint in deleted]


def _score(checkpoint: Checkpoint, *keys: str) -> float | None:
    """The first of these numbers in its manifest, if it is finite; an older Muster wrote ``reward`` for ``score``."""
    try:
        manifest = checkpoint.manifest
    except DamagedCheckpoint:
        return None
    score = next((manifest[key] for key in keys if key in manifest), None)
    return float(score) if isinstance(score, int | float) and math.isfinite(score) else None
