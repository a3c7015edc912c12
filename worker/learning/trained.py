"""Trained policies from checkpoints, loaded without their job and without a simulation."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

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


def choose_checkpoint(gang: Gang, run: Run, wanted: int | str | None) -> Checkpoint:
    """The checkpoint for a user's choice: an iteration, a name, ``best``, or ``latest`` or None for the newest good one. All ranks call it.

    Raises UserError if it does not exist or is damaged; the message lists the existing ones.
    """
    name, problem = None, ""
    if gang.is_main:
        try:
            name = find_checkpoint(run, wanted).name
        except (UserError, DamagedCheckpoint) as error:
            problem = str(error)
    if problem := gang.tell(problem) or "":
        raise UserError(problem)
    # the other ranks list nothing: on a network volume they may not see the newest checkpoint in the directory yet
    chosen = checkpoint_called(run.checkpoints, gang.tell(name) or "")
    assert chosen is not None
    return chosen


def find_checkpoint(run: Run, wanted: int | str | None) -> Checkpoint:
    """As :func:`choose_checkpoint`, for one process. Of two with the same iteration, the later epoch wins."""
    checkpoints = list_checkpoints(run)
    if wanted == "best":
        if (best := best_checkpoint(run)) is None:
            raise UserError(f"run {run.name} has no best checkpoint yet: evaluate two of them, or name an iteration")
        wanted = best.name
    if wanted in (None, "latest"):
        newest = newest_checkpoint(run)
        if newest is None:
            raise UserError(f"run {run.name} has no checkpoint that can be read in {run.checkpoints}; train it first")
        return newest
    found = [c for c in checkpoints if wanted == c.name or (str(wanted).isdecimal() and int(wanted) == c.iteration)]
    if not found:
        there = ", ".join(str(c.iteration) for c in checkpoints) or "none"
        raise UserError(f"run {run.name} has no checkpoint {wanted}; there are: {there}")
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
        learnt = load_learner(checkpoint, device)["algorithm"]["policy"]
        for policy in policies:
            policy.load_state_dict(learnt)
    except (RuntimeError, KeyError) as error:
        raise UserError(f"checkpoint {checkpoint.name}: its policy can't be read: {error}") from error
    return policies


def load_learner(checkpoint: Checkpoint, device: str = "cpu") -> dict[str, Any]:
    """The content of ``learner.pt``. Raises UserError if it holds more than tensors and plain values."""
    from worker.learning.shards import read_file

    return read_file(checkpoint, "learner.pt", device)
