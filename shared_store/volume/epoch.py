"""Fencing: every attempt that may write to a run has an epoch, and only the attempt that the run's ``EPOCH`` names may commit.

Before it launches a gang, the controller creates ``EPOCH.<n>``, exclusively: of several controllers on one store, only one gets
the number, also on NFS and EFS. Then it writes n to ``EPOCH``. A gang that was presumed dead and comes back reads another gang's number
there, and stops. Readers open only ``EPOCH``; ``EPOCH.<n>`` tells controllers which attempt writes.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import socket
import time
from dataclasses import asdict, dataclass

from shared_store.volume.files import (
    make_directory,
    open_regular,
    read_json,
    refuse_links,
    sync_directory,
    write_atomic,
)
from shared_store.volume.layout import Run, StoreError

LARGEST_EPOCH = 10**15 - 1
"""A greater number in ``EPOCH`` is damage: no run has that many attempts."""
_KEPT = 64
"""Number of older claims to keep, so that a controller that froze while it claimed can't free a number."""
_PUBLICATION = 1.0
"""Seconds between a claim and its publication after which the claiming controller counts as dead."""
_LONGEST_CLAIM = 4096
"""Bytes of a claim to read."""


class StaleEpoch(Exception):
    """Another attempt owns the run: this process must stop and must not write."""


@dataclass(frozen=True)
class Claim:
    """The attempt that has an epoch, from ``EPOCH.<n>`` while the attempt is open."""

    controller: str
    """Id of the attempt's controller on this store."""
    job: str
    attempt: int


def read_epoch(run: Run) -> int:
    """The epoch that may write to ``run``; 0 before the first attempt. Raises ValueError if the file is damaged."""
    path = run.path / "EPOCH"
    refuse_links(run.path, 1)
    try:
        with open_regular(path) as file:
            text = file.read(32).decode(errors="replace").strip()
    except FileNotFoundError:
        return 0
    if not re.fullmatch(r"[0-9]{1,15}", text):
        raise ValueError(f"{path}: expected an integer of at most 15 digits, found {text!r}")
    return int(text)


def take_epoch(run: Run, after: int, claim: Claim) -> int:
    """Give the run to ``claim``, with the first free epoch greater than ``after``; returns it.

    ``after``: at least the run's epoch when the caller decided to take the run. If another controller has claimed an epoch and not yet
    published it, this waits up to a second for the publication, which gives the run to that controller. The claim of a controller that
    died in between is skipped.

    Raises:
        StaleEpoch: Another controller has just taken the run.
        ValueError: ``EPOCH`` is damaged, or no epoch is left.
        OSError: The store can't be written.
    """
    epoch = after + 1
    while not _create(run, epoch, claim):
        _await_publication(run, epoch, claim)
        epoch += 1
    _publish(run, epoch)
    return epoch


def raise_epoch(run: Run, epoch: int, claim: Claim | None = None) -> None:
    """Give the run to ``epoch``. Raises StaleEpoch if it is not greater than the run's, or if another attempt has it."""
    current = read_epoch(run)
    if epoch <= current:
        raise StaleEpoch(f"run {run.name}: epoch {epoch} does not follow {current}")
    if not _create(run, epoch, claim):
        raise StaleEpoch(f"run {run.name}: another attempt has epoch {epoch}")
    _publish(run, epoch)


def read_claim(run: Run, epoch: int) -> Claim | None:
    """The open attempt that has ``epoch``; None if it is closed, unknown or damaged. Raises OSError."""
    try:
        value = read_json(run.path / f"EPOCH.{epoch}", _LONGEST_CLAIM) or {}
        return Claim(str(value["controller"]), str(value["job"]), int(value["attempt"]))
    except (ValueError, KeyError, TypeError):
        return None


def close_claim(run: Run, epoch: int) -> None:
    """Mark the attempt with ``epoch`` as closed. The file stays, empty, so that the number is never used again.

    Raises OSError; DamagedFile if the run is a link, or the file is not a regular one.
    """
    refuse_links(run.path, 1)
    with contextlib.suppress(FileNotFoundError), open_regular(run.path / f"EPOCH.{epoch}", write=True) as file:
        file.truncate()
        os.fsync(file.fileno())


def find_epoch(run: Run, epoch: int, patience: float = 10.0) -> None:
    """Check, before a node starts, that this is the volume on which the controller gave the run to ``epoch``.

    Args:
        patience: Seconds for a network file system to show another machine's writes.

    Raises:
        StaleEpoch: Another attempt owns the run.
        StoreError: The epoch is missing: another directory of the same name, or nothing mounted.
    """
    deadline = time.monotonic() + patience
    while (current := read_epoch(run)) < epoch:
        if time.monotonic() >= deadline:
            raise StoreError(
                f"store {run.path.parent.parent} on {socket.gethostname()} is not the controller's: run {run.name} has epoch "
                f"{current} there, not {epoch}; mount the same volume at this path on every node"
            )
        # opening a directory makes NFS look again for files that it cached as absent
        for directory in (run.path.parent, run.path):
            with contextlib.suppress(OSError):
                os.listdir(directory)
        time.sleep(0.2)
    if current > epoch:
        raise _stale(run, epoch, current)


def check_epoch(run: Run, epoch: int) -> None:
    """Raises StaleEpoch if another attempt owns the run.

    A smaller number counts, too: of two controllers that publish at the same instant, the last one owns the run, and exactly one gang
    continues. A missing file proves nothing.
    """
    current = read_epoch(run)
    if current not in (0, epoch):
        raise _stale(run, epoch, current)


def _create(run: Run, epoch: int, claim: Claim | None) -> bool:
    """Create ``EPOCH.<epoch>``; False if it exists, because the number is taken."""
    if epoch > LARGEST_EPOCH:
        raise ValueError(f"{run.path / 'EPOCH'}: no epoch is left after {LARGEST_EPOCH}")
    refuse_links(run.path, 1)
    make_directory(run.path, 2)
    try:
        descriptor = os.open(run.path / f"EPOCH.{epoch}", os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o666)
    except FileExistsError:
        return False
    with open(descriptor, "wb") as file:
        if claim is not None:
            file.write(json.dumps(asdict(claim)).encode())
            file.flush()
        os.fsync(descriptor)
    sync_directory(run.path)  # if a crash of the volume lost the number, it could be used again
    return True


def _await_publication(run: Run, epoch: int, claim: Claim) -> None:
    """Returns once ``epoch`` is sure not to be published: its controller died, or it is the caller's own claim from before a crash."""
    deadline = time.monotonic() + _PUBLICATION
    while time.monotonic() < deadline:
        if (current := read_epoch(run)) >= epoch:
            raise StaleEpoch(f"another controller has just taken run {run.name} with epoch {current}")
        if (other := read_claim(run, epoch)) and other.controller == claim.controller:
            return
        time.sleep(0.05)


def _publish(run: Run, epoch: int) -> None:
    if (current := read_epoch(run)) >= epoch:
        raise _stale(run, epoch, current)
    write_atomic(run.path / "EPOCH", f"{epoch}\n".encode(), levels=0)
    for name in os.listdir(run.path):
        claim = re.fullmatch(r"EPOCH\.([0-9]{1,15})", name)
        if claim and int(claim[1]) < epoch - _KEPT:
            (run.path / name).unlink(missing_ok=True)


def _stale(run: Run, epoch: int, current: int) -> StaleEpoch:
    return StaleEpoch(f"run {run.name}: this attempt has epoch {epoch}, the run now belongs to epoch {current}")
