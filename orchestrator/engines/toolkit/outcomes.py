"""The outcomes and logs of a gang's nodes in the store, by the facts of its handle: for engines that write them in a supervisor's place."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path
from typing import Any

from orchestrator.engines.api import Gang, Handle
from shared_store.contract.node import LOG_LIMIT
from shared_store.volume.files import DamagedFile
from shared_store.volume.layout import Run, Store
from shared_store.volume.node_outcomes import Outcome, read_outcome, write_outcome


def store_facts(gang: Gang) -> dict[str, Any]:
    """The facts that the other functions need in a handle."""
    return {name: getattr(gang, name) for name in ("job", "attempt", "epoch", "run", "store", "log_limit")}


def recorded(handle: Handle, index: int) -> Outcome | None:
    """The outcome of a node; None if the store has none yet. Raises OSError."""
    return read_outcome(_run(handle), handle.facts["job"], handle.facts["attempt"], index)


def all_recorded(handle: Handle) -> dict[int, Outcome]:
    """Those of a gang by node index, with one look at their folder however many nodes there are. Raises OSError."""
    run, job, attempt = _run(handle), handle.facts["job"], handle.facts["attempt"]
    try:
        names = set(os.listdir(run.outcome(job, attempt, 0).parent))
    except FileNotFoundError:
        return {}
    present = [index for index in range(handle.nodes) if run.outcome(job, attempt, index).name in names]
    return {index: outcome for index in present if (outcome := recorded(handle, index)) is not None}


def seen(handle: Handle, index: int, code: int, reason: str, at: float, requested: bool = False) -> Outcome:
    """The outcome of a node without a supervisor, as its engine saw the end.

    Args:
        handle: Of its gang.
        index: The node's.
        code: Its exit code.
        reason: What the engine says of it; empty: what the exit code says.
        at: When it ended [Unix s].
        requested: Whether it ended because others did.
    """
    words = reason or (f"container exited with code {code}" if code else "done")
    return Outcome(index, handle.facts["epoch"], code, None, words, None, at, at, requested)


def record(handle: Handle, outcome: Outcome) -> None:
    """Write the outcome where the run exists and has none of that node. Raises OSError.

    With a link in the file's place nothing is written: what the engine tells of the node counts then.
    """
    run = _run(handle)
    if recorded(handle, outcome.node) is None and run.path.exists():
        with contextlib.suppress(DamagedFile):
            write_outcome(run, handle.facts["job"], handle.facts["attempt"], outcome)


def log_of(handle: Handle, index: int) -> tuple[Path, int]:
    """A node's log, and how many bytes of it are kept."""
    path = _run(handle).log(handle.facts["job"], handle.facts["attempt"], index)
    return path, handle.facts.get("log_limit", LOG_LIMIT)


def _run(handle: Handle) -> Run:
    return Store(handle.facts["store"]).run(handle.facts["run"])
