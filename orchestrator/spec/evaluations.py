"""Jobs that evaluate or read a checkpoint of a training: their spec, and the checkpoints of a running training that are due. No I/O."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from pydantic import ValidationError

from orchestrator.domain.errors import SpecError
from orchestrator.spec.model import Spec, validate
from orchestrator.spec.sections import Evaluation
from shared_store.contract.error_text import explain, path_of
from shared_store.volume.checkpoints import Checkpoint

AUTOMATIC_TAG = "muster:automatic-evaluation"
"""Tag of the jobs that the controller submits by itself; its value is the evaluated checkpoint, ``RUN@ITERATION``."""


def evaluation_document(
    run: str,
    trained: Mapping[str, Any],
    section: Mapping[str, Any],
    name: str | None = None,
    kind: str = "evaluate",
    resources: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """The spec of a job that evaluates or reads a checkpoint of ``run`` on one node.

    Args:
        run: Name of the run.
        trained: Spec of the training.
        section: What its section says beside the run.
        name: Of the job; ``KIND-RUN`` where None.
        kind: Key of the section.
        resources: Of the node; None: those of a node of the training, with at most one GPU.
    """
    if resources is None:
        like = trained.get("resources") or {}
        resources = {**like, "gpus": 1} if like.get("gpus") else like
    return {
        **_kept(trained),
        "name": name or f"{kind}-{run}".replace(".", "-")[:100],
        **({"resources": resources} if resources else {}),
        kind: {"run": run, **section},
    }


def _kept(trained: Mapping[str, Any]) -> dict[str, Any]:
    """What a job has of the training whose policy it reads; its share comes when it is submitted, by who submits it."""
    keys = ("queue", "image", "environment", "secrets")
    return {key: trained[key] for key in keys if trained.get(key) is not None}


def evaluation_settings(spec: Mapping[str, Any] | None) -> Evaluation | None:
    """The section ``evaluation`` of a training's spec; None where there is none. Raises SpecError: a job of the Batch API may say anything."""
    section, train = (spec or {}).get("evaluation"), (spec or {}).get("train")
    if section is None or not isinstance(train, dict) or not isinstance(train.get("iterations"), int):
        return None
    try:
        return Evaluation.model_validate(section)
    except ValidationError as error:
        first: Any = error.errors(include_url=False)[0]
        key = ".".join(str(part) for part in ("evaluation", *path_of(first)))
        raise SpecError(f"{key}: {explain(first)}") from None


def place_of(queue: str, settings: Evaluation, share: str | None = None) -> dict[str, str]:
    """Queue and share of a training's automatic evaluations: ``queue`` and ``share``, the training's, unless the section names a queue."""
    requested = {"queue": settings.queue, "share": settings.share}
    if settings.queue is None:
        requested = {"queue": queue, "share": settings.share or share}
    return {key: value for key, value in requested.items() if value is not None}


def automatic_evaluation(
    run: str, trained: Mapping[str, Any], place: Mapping[str, str], settings: Evaluation, iteration: int
) -> Spec:
    """The job that evaluates a checkpoint beside its training. Trainings may take its place, and it keeps no checkpoint. Raises SpecError.

    ``place``: as :func:`place_of` says; ``iteration``: the checkpoint's.
    """
    section: dict[str, Any] = {
        "checkpoint": iteration,
        "episodes": settings.episodes,
        "worlds": settings.worlds,
        "keep": False,
    }
    if (trained.get("train") or {}).get("accept_changed_robot"):
        section["accept_changed_robot"] = True
    document = evaluation_document(run, {**trained, "queue": None}, section)
    if settings.resources is not None:
        document["resources"] = settings.resources.model_dump()
    document |= {"retry": settings.retry.model_dump(), "preemptible": True, **place}
    return validate(document, f"evaluation of {run}")


@dataclass(frozen=True)
class Counted:
    """The checkpoints of a training that have been looked at."""

    seen: str = ""
    """Name of the newest one."""
    waiting: int = 0
    """Number of checkpoints since the last one that was evaluated."""
    passed: int = 0
    """Number of checkpoints that were due and skipped, because a newer one existed when the previous evaluation ended."""


def first_count(checkpoints: Sequence[Checkpoint], first_epoch: int) -> Counted:
    """For a job whose first attempt has this epoch: checkpoints of the run's earlier jobs do not count."""
    earlier = [checkpoint.name for checkpoint in checkpoints if checkpoint.epoch < first_epoch]
    return Counted(earlier[-1] if earlier else "")


def due(
    checkpoints: Sequence[Checkpoint], counted: Counted, every: int, iterations: int, busy: bool
) -> tuple[Counted, Checkpoint | None]:
    """The progress through the checkpoints, and the one to evaluate now.

    Args:
        checkpoints: All of the run, the newest last.
        counted: The progress after the last look.
        every: Number of checkpoints from one evaluation to the next.
        iterations: Of the whole training, which evaluates its last checkpoint by itself.
        busy: Whether the evaluation before waits or runs: one is open at a time.

    Returns:
        The progress now; and the newest checkpoint, where enough have come since the last one that was evaluated.
    """
    order = {checkpoint.name: (checkpoint.epoch, checkpoint.iteration) for checkpoint in checkpoints}
    last = _order(counted.seen)
    new = [checkpoint for checkpoint in checkpoints if order[checkpoint.name] > last]
    if new:
        count = sum(checkpoint.iteration < iterations for checkpoint in new)
        counted = replace(counted, seen=new[-1].name, waiting=counted.waiting + count)
    newest = checkpoints[-1] if checkpoints else None
    if busy or newest is None or newest.iteration >= iterations or counted.waiting < every:
        return counted, None
    return replace(counted, waiting=0, passed=counted.passed + counted.waiting // every - 1), newest


def _order(name: str) -> tuple[int, int]:
    """Epoch and iteration of the checkpoint of this name; before all others where there is none."""
    iteration, _, epoch = name.partition("-e")
    return (int(epoch), int(iteration)) if epoch else (-1, -1)
