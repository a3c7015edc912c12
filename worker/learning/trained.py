"""Reading a policy back from a checkpoint, without the job that trained it and without a simulation."""

from __future__ import annotations

from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

from shared_store.checkpoints import Checkpoint, DamagedCheckpoint, list_checkpoints, newest_checkpoint
from shared_store.layout import Run
from worker.errors import UserError

if TYPE_CHECKING:
    from rsl_rl.models.mlp_model import MLPModel

    from worker.distributed import Gang


def choose_checkpoint(gang: Gang, run: Run, wanted: int | str | None) -> Checkpoint:
    """The checkpoint that a user means: an iteration, a name, or None for the newest good one. All ranks call it.

    Raises UserError where there is no such checkpoint, or it is damaged; the message says which there are.
    """
    name, problem = None, ""
    if gang.is_main:
        try:
            name = find_checkpoint(run, wanted).name
        except (UserError, DamagedCheckpoint) as error:
            problem = str(error)
    if problem := gang.tell(problem) or "":
        raise UserError(problem)
    name = gang.tell(name)
    return next(checkpoint for checkpoint in list_checkpoints(run) if checkpoint.name == name)


def find_checkpoint(run: Run, wanted: int | str | None) -> Checkpoint:
    """See :func:`choose_checkpoint`; for one process. Of two with the same iteration the later epoch's is meant."""
    checkpoints = list_checkpoints(run)
    if wanted is None:
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


def load_actor(checkpoint: Checkpoint) -> MLPModel:
    """The policy of ``checkpoint`` on the CPU, in evaluation mode."""
    from worker.learning.ppo.models import build_models

    facts = checkpoint.manifest
    config: Any = SimpleNamespace(**facts["ppo"])
    policy = facts["policy"]
    shape = policy.get("observation_shape") or [policy["observation_size"]]  # the name of older checkpoints
    actor, _ = build_models(config, shape, policy["action_size"])
    actor.load_state_dict(load_learner(checkpoint)["ppo"]["actor_state_dict"])
    return actor.eval()


def load_learner(checkpoint: Checkpoint, device: str = "cpu") -> dict[str, Any]:
    """The content of ``learner.pt``. Raises UserError where it holds more than tensors and plain values."""
    from worker.learning.shards import read_file

    return read_file(checkpoint, "learner.pt", device)
