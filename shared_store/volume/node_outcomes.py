"""The outcomes of an attempt's nodes, each committed by the node's supervisor before it exits.

A controller that was down when a gang ended reads it here, when the engine no longer knows it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

from shared_store.contract.documents import DocumentError, parse
from shared_store.contract.faults import Fault
from shared_store.volume.files import read_json, refuse_links, write_json
from shared_store.volume.layout import Run

LONGEST_TEXT = 16 << 10
"""Characters of a reason, a message or a traceback; longer texts are truncated at the write, and again at the read, since a job can
write the file itself."""
_LATEST = 2.0**40
"""Upper limit of Unix times [s] in an outcome."""
_LEVELS = 4
"""Directories from that of an outcome up to its run: ``<run>/outcomes/<job>/<attempt>``."""
OUT_OF_MEMORY = "OutOfMemoryError: Container killed due to memory usage"
"""AWS's reason for a container that exceeded its memory limit."""
EX_TEMPFAIL = 75
"""Exit code for "checkpointed and exited on request: start again, and don't count it as a failure" (sysexits.h)."""


@dataclass(frozen=True)
class FirstError:
    """The first error on a node."""

    rank: int
    message: str
    traceback: str
    time: float
    """Its Unix time [s]."""
    fault: Fault | None = None
    """None where another attempt may not meet it. Outcomes of older versions lack it."""


@dataclass(frozen=True)
class Outcome:
    """The end of one node of one attempt."""

    node: int
    epoch: int
    exit_code: int
    """0 done, 75 exited on request, 128 + n killed by signal n, else the program's own."""
    signal: str | None
    reason: str
    error: FirstError | None
    started: float
    ended: float
    """Unix times [s] of the first rank's start and of the last rank's end."""
    requested: bool = False
    """Whether its ranks ended on request, so that the cause of the gang's end is elsewhere. Outcomes of older versions lack it."""
    cannot_start: bool = False
    """Whether its program could not be started. Outcomes of older versions lack it."""


def first_cause(ends: Sequence[tuple[bool, float]]) -> int:
    """The failure that caused the others: the earliest one not on request, else the earliest of all.

    Args:
        ends: For each failure, whether the end was requested, and its time (Unix time [s]). Not empty.

    Returns:
        Its index in ``ends``; of equal times the smallest.
    """
    return min(range(len(ends)), key=lambda index: ends[index])


def write_outcome(run: Run, job: str, attempt: int, outcome: Outcome) -> None:
    """Commit ``outcome``, with bounded texts.

    Raises OSError if the store can't be written, DamagedFile if a directory on the way is a link.
    """
    path = run.outcome(job, attempt, outcome.node)
    refuse_links(path.parent, _LEVELS)
    write_json(path, asdict(bounded(outcome)), levels=_LEVELS - 1)


def read_outcome(run: Run, job: str, attempt: int, node: int) -> Outcome | None:
    """The committed outcome of a node; None if it does not exist yet or is damaged. Raises OSError."""
    try:
        path = run.outcome(job, attempt, node)
        refuse_links(path.parent, _LEVELS)
        value = read_json(path)
        return None if value is None else parse_outcome(value)
    except ValueError:
        return None


def parse_outcome(value: dict[str, Any]) -> Outcome:
    """The outcome from its ``asdict`` form, with bounded texts. Raises ValueError if it is damaged."""
    value = {"requested" if key == "asked" else key: each for key, each in value.items()}  # an older version's name
    outcome: Outcome = parse(Outcome, {**value, "error": value.get("error") or None}, "outcome")
    error = outcome.error
    times = (outcome.started, outcome.ended, error.time if error else 0)
    numbers = (outcome.node, outcome.epoch, error.rank if error else 0)
    if not all(0 <= each < _LATEST for each in times) or not all(abs(each) < 2**63 for each in numbers):
        raise DocumentError("outcome: a time or a number is out of range")
    if not 0 <= outcome.exit_code <= 255:
        raise DocumentError("outcome: exit_code is not one of a process")
    return bounded(outcome)


def bounded(outcome: Outcome) -> Outcome:
    """The outcome with at most :data:`LONGEST_TEXT` characters in each of its texts: the end of a traceback, the start of others."""
    error = outcome.error
    if error is not None:
        error = replace(error, message=_cut(error.message), traceback=_cut(error.traceback, keep_end=True))
    signal = None if outcome.signal is None else outcome.signal[:32]
    return replace(outcome, signal=signal, reason=_cut(outcome.reason), error=error)


def _cut(text: str, keep_end: bool = False) -> str:
    if len(text) <= LONGEST_TEXT:
        return text
    note = f"({len(text) - LONGEST_TEXT + 64} characters left out)"
    kept = LONGEST_TEXT - 64
    return f"{note} …\n{text[-kept:]}" if keep_end else f"{text[:kept]} … {note}"
