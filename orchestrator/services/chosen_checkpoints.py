"""Look-up of the checkpoint that a request names, and the error if there is none."""

from __future__ import annotations

from typing import Literal

from orchestrator.domain.errors import ClientError
from shared_store.volume.checkpoints import (
    Checkpoint,
    DamagedCheckpoint,
    NewerFormat,
    best_checkpoint,
    list_checkpoints,
)
from shared_store.volume.layout import Run

CONFLICT = 409
"""The request is well formed, but conflicts with the present state."""


def choose(run: Run, wanted: int | Literal["best", "latest"] | None) -> Checkpoint | None:
    """The requested checkpoint; None for the newest one of a run that has none. Raises ClientError where it does not exist."""
    checkpoints = list_checkpoints(run)
    there = ", ".join(str(checkpoint.iteration) for checkpoint in checkpoints) or "none yet"
    if wanted in (None, "latest"):
        return checkpoints[-1] if checkpoints else None
    if wanted == "best":
        chosen = best_checkpoint(run)
        problem = (
            ": no checkpoint has a score yet, which is a mean over at least 100 episodes, and no two are evaluated; "
            "name an iteration"
        )
    else:
        chosen = next((each for each in reversed(checkpoints) if each.iteration == wanted), None)
        problem = f" has no checkpoint of iteration {wanted}; it has"
    if chosen is None:
        raise ClientError(f"run {run.name}{problem}: {there}", 404)
    return chosen


def refusal(run: Run, chosen: Checkpoint, error: DamagedCheckpoint) -> ClientError:
    """The error of a checkpoint that can't be used."""
    if isinstance(error, NewerFormat):
        return ClientError(f"run {run.name}: {error}", CONFLICT)
    others = [str(each.iteration) for each in list_checkpoints(run) if each.name != chosen.name]
    return ClientError(f"run {run.name}: {error}; choose another ({', '.join(others) or 'there is none'})", CONFLICT)
