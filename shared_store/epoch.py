"""Fencing: every attempt that may write to a run has an epoch, and only the newest one may commit.

The controller writes a greater number to the run's ``EPOCH`` file before it launches a gang. A gang that was believed dead and
comes back reads a number that is not its own, and stops.
"""

from __future__ import annotations

import contextlib
import os
import re
import socket
import time

from shared_store.files import write_atomic
from shared_store.layout import Run, StoreError


class StaleEpoch(Exception):
    """A newer attempt owns the run: this process must stop and must not write."""


def read_epoch(run: Run) -> int:
    """The epoch that may write to ``run``; 0 before the first attempt. Raises ValueError where the file is damaged."""
    path = run.path / "EPOCH"
    try:
        text = path.read_bytes().decode(errors="replace").strip()
    except FileNotFoundError:
        return 0
    if not re.fullmatch(r"[0-9]+", text):
        raise ValueError(f"{path}: expected a whole number, found {text!r}")
    return int(text)


def raise_epoch(run: Run, epoch: int) -> None:
    """Give the run to ``epoch``. Raises StaleEpoch where the run already belongs to it or to a later one."""
    current = read_epoch(run)
    if epoch <= current:
        raise StaleEpoch(f"run {run.name}: epoch {epoch} does not follow {current}")
    write_atomic(run.path / "EPOCH", f"{epoch}\n".encode())


def find_epoch(run: Run, epoch: int, patience: float = 10.0) -> None:
    """Make sure that this is the volume on which the controller gave the run to ``epoch``, before a node starts on it.

    Args:
        patience: Seconds that a network file system gets to show what another machine has written.

    Raises:
        StaleEpoch: A newer attempt owns the run.
        StoreError: The epoch is not here: another directory of the same name, or nothing mounted.
    """
    deadline = time.monotonic() + patience
    while (current := read_epoch(run)) < epoch:
        if time.monotonic() >= deadline:
            raise StoreError(
                f"store {run.path.parent.parent} on {socket.gethostname()} is not the controller's: run {run.name} has epoch "
                f"{current} there, not {epoch}; mount the same volume at this path on every node"
            )
        # to open a directory has NFS look again at what it took for absent
        for directory in (run.path.parent, run.path):
            with contextlib.suppress(OSError):
                os.listdir(directory)
        time.sleep(0.2)
    if current > epoch:
        raise _stale(run, epoch, current)


def _stale(run: Run, epoch: int, current: int) -> StaleEpoch:
    return StaleEpoch(f"run {run.name}: this attempt has epoch {epoch}, the run now belongs to epoch {current}")


def check_epoch(run: Run, epoch: int) -> None:
    """Raises StaleEpoch where a newer attempt owns the run."""
    current = read_epoch(run)
    if current > epoch:
        raise _stale(run, epoch, current)
