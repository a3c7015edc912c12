"""How each node of an attempt ended, committed by its supervisor before it leaves.

A controller that was down when a gang ended reads here what the engine can't tell it any more.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any

from shared_store.files import read_json, write_json
from shared_store.layout import Run

LONGEST_TEXT = 16 << 10
"""Characters that are read of a reason, a message or a traceback."""
_NUMBER = int | float
EX_TEMPFAIL = 75
"""Exit code for "checkpointed and left on request: start me again, and don't count it as a failure" (sysexits.h)."""


@dataclass(frozen=True)
class FirstError:
    """The first thing that went wrong on a node."""

    rank: int
    message: str
    traceback: str
    time: float
    """Unix time [s] at which it happened."""


@dataclass(frozen=True)
class Outcome:
    """The end of one node of one attempt."""

    node: int
    epoch: int
    exit_code: int
    """0 done, 75 left on request, 128 + n killed by signal n, else the program's own."""
    signal: str | None
    reason: str
    error: FirstError | None
    started: float
    ended: float
    """Unix times [s] of the first rank's start and of the last rank's end."""


def write_outcome(run: Run, job: str, attempt: int, outcome: Outcome) -> None:
    """Commit ``outcome``. Raises OSError where the store can't be written."""
    write_json(run.outcome(job, attempt, outcome.node), asdict(outcome))


def read_outcome(run: Run, job: str, attempt: int, node: int) -> Outcome | None:
    """The committed outcome of a node; None while there is none, or where it is damaged. Raises OSError."""
    try:
        value: dict[str, Any] | None = read_json(run.outcome(job, attempt, node))
        return None if value is None else parse_outcome(value)
    except (ValueError, TypeError):
        return None


def parse_outcome(value: dict[str, Any]) -> Outcome:
    """The outcome of which ``asdict`` made this, its texts bounded. Raises TypeError where it is damaged."""
    error = FirstError(**value["error"]) if value.get("error") else None
    outcome = Outcome(**{**value, "error": error})
    _check(outcome, node=int, epoch=int, exit_code=int, signal=str | None, reason=str, started=_NUMBER, ended=_NUMBER)
    if error is not None:
        _check(error, rank=int, message=str, traceback=str, time=_NUMBER)
        message, traceback = error.message[:LONGEST_TEXT], error.traceback[:LONGEST_TEXT]
        outcome = replace(outcome, error=replace(error, message=message, traceback=traceback))
    return replace(outcome, reason=outcome.reason[:LONGEST_TEXT])


def _check(value: object, **kinds: Any) -> None:
    for name, kind in kinds.items():
        found = getattr(value, name)
        if not isinstance(found, kind) or (isinstance(found, int) and abs(found) >= 2**63):
            raise TypeError(f"{name} is of the wrong type or too large")
