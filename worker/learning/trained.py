"""Trained policies from checkpoints, loaded without their job and without a simulation."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from shared_store.contract.error_text import unknown_iteration
from shared_store.volume.checkpoints import (
    Checkpoint,
    DamagedCheckpoint,
    best_checkpoint,
    checkpoint_called,
    list_checkpoints,
    newest_checkpoint,
)
from shared_store.volume.layout import Run
from worker.settings.errors import UserError

if TYPE_CHECKING:
    from worker.learning.algorithm import Policy
    from worker.learning.distributed import Gang


def choose_checkpoint(gang: Gang, run: Run, choice: int | str | None) -> Checkpoint:
    """The checkpoint for a user's choice: an iteration, a name, ``best``, or ``latest`` or None for the newest good one. All ranks call it.

    Raises UserError if it does not exist or is damaged; the message lists the existing ones.
    """
    errors = UserError, DamagedCheckpoint
    chosen, problem = chosen_by_main(gang, run.checkpoints, lambda: find_checkpoint(run, choice), errors)
    if problem:
        raise UserError(problem)
    assert chosen is not None
    return chosen


def chosen_by_main(
    gang: Gang, folder: Path, choose: Callable[[], Checkpoint | None], errors: tuple[type[Exception], ...]
) -> tuple[Checkpoint | None, str]:
    """The checkpoint in ``folder`` that the main rank chooses, and the message if it raised one of ``errors``. All ranks call it.

    The other ranks list nothing: on a network volume they may not see the newest checkpoint in the directory yet.
    """
    name, problem = None, ""
    if gang.is_main:
        try:
            found = choose()
            name = found.name if found else None
        except errors as error:
            problem = str(error)
    if problem := gang.broadcast_text(problem) or "":
        return None, problem
    return checkpoint_called(folder, gang.broadcast_text(name) or ""), ""


def find_checkpoint(run: Run, choice: int | str | None) -> Checkpoint:
    """As :func:`choose_checkpoint`, for one process. Of two with the same iteration, the later epoch wins."""
    checkpoints = list_checkpoints(run)
    if choice == "best":
        if (best := best_checkpoint(run)) is None:
            raise UserError(f"run {run.name} has no best checkpoint yet: evaluate two of them, or name an iteration")
        choice = best.name
    if choice in (None, "latest"):
        newest = newest_checkpoint(run)
        if newest is None:
            raise UserError(f"run {run.name} has no checkpoint that can be read in {run.checkpoints}; train it first")
        return newest
    found = [c for c in checkpoints if choice == c.name or (str(choice).isdecimal() and int(choice) == c.iteration)]
    if not found:
        raise UserError(unknown_iteration(run.name, choice, (each.iteration for each in checkpoints)))
    found[-1].verify()
    return found[-1]


def load_policy(checkpoint: Checkpoint, device: str = "cpu") -> Policy:
    """The policy of ``checkpoint``, without the training state.

    >>> actions = load_policy(checkpoint).act({"policy": observations})  # shape (n, actions) for (n, observations)

    Raises UserError if the checkpoint is of another version, or its algorithm can't be found or refuses its former settings.
    """
    return load_policies(checkpoint, device, 1)[0]


def load_policies(checkpoint: Checkpoint, device: str, count: int) -> list[Policy]:
    """:func:`load_policy`, several times: each remembers its own episodes."""
    from worker.learning.algorithms import find_algorithm, refusal
    from worker.learning.setup import spaces_from
    from worker.learning.shards import read_file

    facts = checkpoint.manifest
    if "algorithm" not in facts:
        raise UserError(f"checkpoint {checkpoint.name} is of an older Muster, which knew no algorithms")
    algorithm = find_algorithm(facts["algorithm"])
    try:
        settings = algorithm.config_type(**facts["settings"])
        spaces = spaces_from(facts["policy"])
        policies = [algorithm.build_policy(settings, spaces, device) for _ in range(count)]
    except (TypeError, ValueError) as error:
        refused = refusal("settings", error).removeprefix("train.")
        raise UserError(
            f"checkpoint {checkpoint.name}: algorithm {facts['algorithm']} refuses what it was trained with: {refused}"
        ) from error
    try:
        learnt = read_file(checkpoint, "learner.pt", device)["algorithm"]["policy"]
        for policy in policies:
            policy.load_state_dict(learnt)
    except (RuntimeError, KeyError) as error:
        raise UserError(f"checkpoint {checkpoint.name}: its policy can't be read: {error}") from error
    return policies
