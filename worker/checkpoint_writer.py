"""The writer of one rank's checkpoint files: a process of its own, so that the training loop, its GIL and its collectives stay free.

``python -m worker.checkpoint_writer`` is started by :class:`worker.learning.saving.Saver`. It reads one JSON order a line on standard input,
takes the files' content from a memory file (inherited descriptor), writes, fsyncs and digests them, and answers one JSON line an
order on standard output. The main rank's writer then waits until every rank's files are durable and the metrics records up to the
save's iteration are written, and commits. Orders are carried out one after the other: a later save never overtakes an earlier one.
Imports no torch.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import select
import time
from pathlib import Path
from typing import Any

from shared_store.volume.checkpoints import CheckpointWriter
from shared_store.volume.epoch import StaleEpoch, check_epoch
from shared_store.volume.files import read_json, sync_file, write_json
from shared_store.volume.layout import Run

GATHER_SECONDS = 120.0
"""Time that the main rank's writer waits for the files of the other ranks [s]."""
_POLL = 0.02
"""Seconds between two checks of what the main rank's writer waits for."""
_CHUNK = 1 << 20


class Abandoned(Exception):
    """The save will not be completed; the message says why."""


class Orders:
    """Standard input as lines, readable without blocking; ``abandon`` orders are kept apart."""

    def __init__(self) -> None:
        self._buffer = b""
        self._waiting: list[dict[str, Any]] = []
        self.abandoned: set[int] = set()
        self.ended = False

    def next(self) -> dict[str, Any] | None:
        """The next save; None at the end of the input. Waits."""
        while not self._waiting and not self.ended:
            self.read(None)
        return self._waiting.pop(0) if self._waiting else None

    def read(self, seconds: float | None) -> None:
        """Read the input, after waiting up to ``seconds`` for some (None: until some comes)."""
        if self.ended or not select.select([0], [], [], seconds)[0]:
            return
        chunk = os.read(0, 65536)
        self.ended = not chunk
        *lines, self._buffer = (self._buffer + chunk).split(b"\n")
        for line in lines:
            order = json.loads(line)
            if "abandon" in order:
                self.abandoned.add(order["abandon"])
            else:
                self._waiting.append(order)


def save(order: dict[str, Any], orders: Orders) -> dict[str, Any]:
    """Carry out one save; returns the answer: ``committed``, ``written``, ``failed`` or ``stale`` with its text."""
    started = time.monotonic()
    run = Run(Path(order["run"]))
    writer = None
    try:
        check_epoch(run, order["epoch"])
        writer = CheckpointWriter(run, order["iteration"], order["epoch"])
        digests = {
            name: _write(writer.path / name, order["memory"], start, size) for name, start, size in order["files"]
        }
        write_json(writer.path / f".rank-{order['rank']}.json", digests, levels=0)
        if order["facts"] is None:
            return {"written": writer.name, "seconds": time.monotonic() - started}
        for rank in range(order["ranks"]):
            digests |= _gather(writer.path, rank, order["iteration"], orders)
        recorded = _wait_for_records(order, orders)
        checkpoint = writer.commit(order["facts"], order["keep"], digests)
        seconds = time.monotonic() - started
        return {"committed": checkpoint.name, "recorded": recorded, "seconds": seconds, "bytes": checkpoint.size}
    except StaleEpoch as error:
        return {"stale": str(error)}
    except OSError as error:
        _give_up(writer, order)
        failed = f"{error.strerror or error}: {error.filename or run.checkpoints}"
        return {"failed": failed, "iteration": order["iteration"]}
    except (Abandoned, ValueError) as error:  # ValueError: EPOCH is damaged
        _give_up(writer, order)
        return {"failed": str(error), "iteration": order["iteration"]}


def _give_up(writer: CheckpointWriter | None, order: dict[str, Any]) -> None:
    """Take back what this rank wrote: on a full volume it is room that everything else needs."""
    if writer is None:
        return
    with contextlib.suppress(OSError):
        for name, _, _ in order["files"]:
            (writer.path / name).unlink(missing_ok=True)
        (writer.path / f".rank-{order['rank']}.json").unlink(missing_ok=True)
        writer.path.rmdir()  # by the last one; the others find it not empty


def _write(path: Path, memory: int, start: int, size: int) -> dict[str, Any]:
    """Copy ``size`` bytes of the memory file to ``path``, durably; returns their size and digest."""
    digest = hashlib.sha256()
    with open(path, "wb") as file:
        for offset in range(start, start + size, _CHUNK):
            chunk = os.pread(memory, min(_CHUNK, start + size - offset), offset)
            digest.update(chunk)
            file.write(chunk)
    sync_file(path)
    return {"size": size, "sha256": digest.hexdigest()}


def _gather(directory: Path, rank: int, iteration: int, orders: Orders) -> dict[str, Any]:
    """The file of rank ``rank``. Raises Abandoned where it does not come."""
    deadline = time.monotonic() + GATHER_SECONDS
    name = f".rank-{rank}.json"
    while name not in os.listdir(directory):  # a listing, because NFS remembers that a name was not there
        if iteration in orders.abandoned:
            raise Abandoned("another rank could not write its files")
        if time.monotonic() > deadline:
            raise Abandoned(f"the files of rank {rank} did not come within {GATHER_SECONDS:g} s")
        orders.read(_POLL)
    return read_json(directory / name) or {}


def _wait_for_records(order: dict[str, Any], orders: Orders) -> bool:
    """Wait until the records up to the save's iteration are written, for the time that the order gives; returns whether they are."""
    waited = order.get("records")
    if waited is None:
        return True
    deadline = time.monotonic() + waited["seconds"]
    while int.from_bytes(os.pread(waited["memory"], 8, 0), "little") < order["iteration"]:  # 0 before the first
        if orders.ended or time.monotonic() > deadline:
            return False
        orders.read(_POLL)
    return True


if __name__ == "__main__":
    received = Orders()
    while (each := received.next()) is not None:
        print(json.dumps(save(each, received)), flush=True)
