"""Checkpoints: committed whole or not at all, verified when they are read, never written twice.

``checkpoints/<iteration, 8 digits>-e<epoch>/`` holds ``manifest.json`` and the files that it lists with size and SHA-256. The
directory appears by a rename, after everything in it is durable. ``LATEST`` is a hint for people; the truth is the listing.
"""

from __future__ import annotations

import contextlib
import hashlib
import math
import os
import re
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from shared_store.epoch import StaleEpoch, check_epoch
from shared_store.evaluations import by_checkpoint, kept_checkpoints
from shared_store.files import (
    DamagedFile,
    open_regular,
    read_json,
    remove_tree,
    sync_directory,
    write_atomic,
    write_json,
)
from shared_store.layout import Run

FORMAT = 1
_NAME = re.compile(r"([0-9]{8})-e([0-9]{1,18})")
_MAKING = re.compile(r"\.([0-9]{8})-e([0-9]{1,18})\.tmp")
_FILE = re.compile(r"[A-Za-z0-9_][A-Za-z0-9._-]{0,199}")
"""What a file of a checkpoint may be called: never a path that leads elsewhere."""


class DamagedCheckpoint(Exception):
    """A checkpoint can't be used; the message names it, the file, and what is wrong with it."""


class NewerFormat(DamagedCheckpoint):
    """A newer Muster wrote the checkpoint: nothing is wrong with it, so nobody may set it aside."""


@dataclass(frozen=True)
class Checkpoint:
    """A committed checkpoint. ``iteration`` is how many iterations were done when it was taken."""

    path: Path
    iteration: int
    epoch: int

    @property
    def name(self) -> str:
        return self.path.name

    @cached_property
    def manifest(self) -> dict[str, Any]:
        """The content of ``manifest.json``. Raises DamagedCheckpoint where there is none that can be read."""
        try:
            manifest = read_json(self.path / "manifest.json")
        except (OSError, ValueError) as error:
            raise DamagedCheckpoint(f"checkpoint {self.name}: manifest.json can't be read ({error})") from error
        if manifest is None or not isinstance(manifest.get("files"), dict):
            raise DamagedCheckpoint(f"checkpoint {self.name}: manifest.json is missing or empty")
        for name, entry in manifest["files"].items():
            if not _FILE.fullmatch(name):
                raise DamagedCheckpoint(
                    f"checkpoint {self.name}: manifest.json names {name[:60]!r}, which is no file of it"
                )
            if not isinstance(entry, dict) or not (
                _is_size(entry.get("size")) and isinstance(entry.get("sha256"), str)
            ):
                raise DamagedCheckpoint(f"checkpoint {self.name}: manifest.json has no size and digest of {name}")
        if not isinstance(manifest.get("format"), int):
            raise DamagedCheckpoint(f"checkpoint {self.name}: manifest.json has no format")
        if manifest["format"] > FORMAT:
            raise NewerFormat(
                f"checkpoint {self.name}: has format {manifest['format']}, this Muster reads up to {FORMAT}; upgrade Muster"
            )
        for key in ("created", "reward", "score", "score_error", "worlds", "world_size"):
            if isinstance(manifest.get(key), str | list | dict):
                raise DamagedCheckpoint(f"checkpoint {self.name}: manifest.json: {key} is not a number")
        return manifest

    @property
    def size(self) -> int:
        """Bytes of all the files that the manifest lists."""
        return sum(entry["size"] for entry in self.manifest["files"].values())

    def verify(self) -> None:
        """Raises DamagedCheckpoint, naming the first file that is missing, truncated or altered."""
        for name, entry in sorted(self.manifest["files"].items()):
            path = self.path / name
            try:
                with open_regular(path) as file:
                    size = os.fstat(file.fileno()).st_size
                    if size != entry["size"]:
                        raise DamagedCheckpoint(
                            f"checkpoint {self.name}: {name} has {size} bytes, {entry['size']} were written"
                        )
                    if hashlib.file_digest(file, "sha256").hexdigest() != entry["sha256"]:
                        raise DamagedCheckpoint(
                            f"checkpoint {self.name}: the content of {name} was altered (SHA-256 differs)"
                        )
            except DamagedFile:
                raise DamagedCheckpoint(f"checkpoint {self.name}: {name} is not a regular file") from None
            except FileNotFoundError:
                raise DamagedCheckpoint(f"checkpoint {self.name}: {name} is missing") from None
            except OSError as error:
                raise DamagedCheckpoint(f"checkpoint {self.name}: {name} can't be read ({error.strerror})") from error


def checkpoint_called(directory: Path, name: str) -> Checkpoint | None:
    """The checkpoint of that name in ``directory``, whether it exists or not; None where no checkpoint can be called so."""
    match = _NAME.fullmatch(name)
    return Checkpoint(directory / match[0], int(match[1]), int(match[2])) if match else None


def list_checkpoints(run: Run) -> list[Checkpoint]:
    """Every committed checkpoint, the newest last.

    A later epoch is newer whatever its iteration: each attempt starts from the newest of those before it, unless a person
    chose an older one, and then the later history is the one that counts.
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
    """The checkpoint that an attempt goes on from: the newest one that verifies; None where there is none.

    Args:
        run: The run.
        chosen: Name of the checkpoint that a person asked for. It stands until the job that was asked has committed one of
            its own, that is one of epoch ``chosen_since`` or later.
        chosen_since: Epoch of that job's first attempt.
        damaged: Called for each newer one that does not verify (to name it and to set it aside).

    Raises:
        DamagedCheckpoint: The chosen one is missing or does not verify: a person's choice is never replaced by a guess.
    """
    for checkpoint in reversed(list_checkpoints(run)):
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
    for checkpoint in list_checkpoints(run):
        if checkpoint.name == chosen:
            checkpoint.verify()
            return checkpoint
    raise DamagedCheckpoint(f"checkpoint {chosen}: not in run {run.name}")


def best_checkpoint(run: Run) -> Checkpoint | None:
    """The best checkpoint, the later one of equals; None where none has been evaluated or has a score yet.

    Where two or more have been evaluated in the worlds of their training, it is the one with the greatest mean return of those that are
    there; one alone would be the best of one. Else it is the one with the greatest score, which is a mean over many episodes of the training; the reward of
    the one iteration before a checkpoint counts for nothing here.
    """
    checkpoints = list_checkpoints(run)
    evaluated = by_checkpoint(run)
    if len(evaluated) > 1 and (judged := best_evaluated(checkpoints, evaluated)):
        return judged
    best, found = None, -math.inf
    for checkpoint in checkpoints:
        try:
            score = checkpoint.manifest.get("score")
        except DamagedCheckpoint:
            continue
        if isinstance(score, int | float) and found <= score < math.inf:
            best, found = checkpoint, score
    return best


def best_evaluated(checkpoints: Sequence[Checkpoint], evaluated: Mapping[str, Mapping[str, Any]]) -> Checkpoint | None:
    """The one with the greatest mean return, the later one of equals; None where none is evaluated.

    Args:
        checkpoints: The newest last.
        evaluated: As :func:`shared_store.evaluations.by_checkpoint` has it.
    """
    judged = [checkpoint for checkpoint in reversed(checkpoints) if checkpoint.name in evaluated]
    return max(judged, key=lambda checkpoint: float(evaluated[checkpoint.name]["mean_return"]), default=None)


def set_aside(checkpoint: Checkpoint) -> Path:
    """Take a damaged checkpoint out of the listing without deleting it; returns where it is now."""
    target = checkpoint.path.with_name(f"{checkpoint.name}.damaged")
    suffix = 1
    while target.exists():
        suffix += 1
        target = checkpoint.path.with_name(f"{checkpoint.name}.damaged-{suffix}")
    os.rename(checkpoint.path, target)
    sync_directory(target.parent)
    return target


def sweep(run: Run, up_to: tuple[int, int] | None = None) -> list[str]:
    """Delete what interrupted commits and deletions left behind; returns the names. For the newest epoch's main rank only.

    ``up_to``: epoch and iteration of a checkpoint; those in the making that come after it are left alone.
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
    """One checkpoint in the making: every rank writes its own files into ``path``, durably, then the main rank commits."""

    def __init__(self, run: Run, iteration: int, epoch: int) -> None:
        self.run, self.iteration, self.epoch = run, iteration, epoch
        self.name = f"{iteration:08d}-e{epoch}"
        self.path = run.checkpoints / f".{self.name}.tmp"
        run.checkpoints.mkdir(exist_ok=True)  # not its parents: a run that somebody deleted does not come back in part
        self.path.mkdir(exist_ok=True)

    def commit(
        self, facts: Mapping[str, Any], keep: int | None = None, digests: Mapping[str, Any] | None = None
    ) -> Checkpoint:
        """Publish the checkpoint: manifest, fsync, fence, rename, ``LATEST``, retention. Main rank only, after all files.

        Args:
            facts: What else the manifest says (world size, worlds, reward, versions); JSON values.
            keep: How many of the newest checkpoints to keep; None keeps all. The best by ``score`` is always kept.
            digests: ``{name: {"size", "sha256"}}`` of every file, as those who wrote them know them; read back where None.

        Raises:
            StaleEpoch: A newer attempt owns the run; nothing was published.
            FileExistsError: The name is committed already; it is never written twice.
            OSError: The volume is full or gone; the last checkpoint stands.
        """
        for notes in self.path.glob(".*"):
            notes.unlink()
        files = digests or {
            entry.name: {"size": entry.stat().st_size, "sha256": _digest(Path(entry.path))}
            for entry in sorted(os.scandir(self.path), key=lambda entry: entry.name)
            if entry.name != "manifest.json"
        }
        manifest = {
            "format": FORMAT,
            "iteration": self.iteration,
            "epoch": self.epoch,
            "created": time.time(),
            "files": files,
        }
        write_json(self.path / "manifest.json", {**facts, **manifest})
        target = self.run.checkpoints / self.name
        if target.exists():
            raise FileExistsError(f"checkpoint {self.name} exists already in {self.run.checkpoints}")
        check_epoch(self.run, self.epoch)
        os.rename(self.path, target)
        sync_directory(self.run.checkpoints)
        # The checkpoint is committed. What fails from here on costs a hint or space, and an attempt that was frozen in the rename
        # must not prune what its successor made.
        with contextlib.suppress(OSError, StaleEpoch):
            check_epoch(self.run, self.epoch)
            if keep is not None:
                retain(self.run, keep)
            # every rank's writer takes its saves in order: nobody works any more on an earlier one that failed
            sweep(self.run, up_to=(self.epoch, self.iteration))
            write_atomic(self.run.checkpoints / "LATEST", f"{self.name}\n".encode())
        return Checkpoint(target, self.iteration, self.epoch)


def retain(run: Run, keep: int) -> list[str]:
    """Delete all but the newest ``keep`` checkpoints, the one with the greatest ``score``, the best evaluated one, and those that an
    export, or an evaluation that keeps its checkpoint, was made of or waits for; returns the deleted names.
    """
    checkpoints = list_checkpoints(run)
    scored = [(score, c.name) for c in checkpoints if (score := _score(c)) is not None]
    kept = {c.name for c in checkpoints[-max(1, keep) :]} | ({max(scored)[1]} if scored else set())
    kept |= kept_checkpoints(run)
    best = best_evaluated(checkpoints, by_checkpoint(run))
    kept |= {best.name} if best else set()
    kept |= {path.name for path in run.exports.glob("*")}
    deleted = [checkpoint for checkpoint in checkpoints if checkpoint.name not in kept]
    for checkpoint in deleted:
        remove_tree(checkpoint.path)
    return [checkpoint.name for checkpoint in deleted]


def _score(checkpoint: Checkpoint) -> float | None:
    """How good the policy was: ``score`` of the manifest, or ``reward`` of one that an older Muster wrote."""
    try:
        manifest = checkpoint.manifest
    except DamagedCheckpoint:
        return None
    score = manifest.get("score", manifest.get("reward"))
    return float(score) if isinstance(score, int | float) and math.isfinite(score) else None


def _is_size(value: object) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 2**63


def _digest(path: Path) -> str:
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
