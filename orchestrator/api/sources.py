"""The other runs that a job from YAML reads: those that it evaluates or exports, and the teacher that its policy imitates."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from dataclasses import dataclass

from orchestrator.api import permissions
from orchestrator.api.context import Context, find_run
from orchestrator.api.errors import ClientError
from orchestrator.api.permissions import Operation
from orchestrator.definition import GangNeeds
from orchestrator.excerpts import shown
from orchestrator.ownership import owner_of
from orchestrator.tables import RunRecord
from shared_store.checkpoints import list_checkpoints
from shared_store.layout import NAME

_TEACHER = "train.rsl_rl.teacher_checkpoint"


@dataclass(frozen=True, order=True)
class Source:
    """A run that a job reads."""

    run: str
    key: str
    """Of the spec, which names it."""
    checkpoint: str = ""
    """Of a teacher: the iteration or the name of its checkpoint; the newest one where empty."""


def sources_of(needs: GangNeeds) -> list[Source]:
    """What a job reads; each node reads the spec of its own environment. Raises ClientError."""
    specs = {node.environment.get("MUSTER_SPEC", "") for node in needs.nodes}
    return sorted({source for text in specs for source in _sources(text)})


def check_sources(context: Context, needs: GangNeeds, is_waiting: bool) -> None:
    """The runs are there and have what is read of them, unless the job waits for another one that makes them.

    The caller may read them. A job that goes on with a training has its teacher in the training's checkpoint, and needs that run no
    more. Raises ClientError.
    """
    for source in sources_of(needs):
        run = context.run(source.run)
        is_teacher = source.key == _TEACHER
        if is_teacher and run.is_missing() and _goes_on(context, needs):
            continue
        if not is_waiting:
            try:
                find_run(context.controller, source.run)
            except ClientError as error:
                raise ClientError(f"{source.key}: {error}" if is_teacher else str(error), error.status) from None
        if permissions.visible_queues() is not None:
            nobodys = RunRecord(name=source.run, queue="")
            permissions.check(Operation.SUBMIT_JOB, owner_of(context.session, run) or nobodys)
        if is_teacher and not is_waiting:
            _check_checkpoint(context, source)


def _goes_on(context: Context, needs: GangNeeds) -> bool:
    named = needs.setting("MUSTER_RUN")
    return bool(named) and bool(list_checkpoints(context.run(named)))


def _check_checkpoint(context: Context, source: Source) -> None:
    checkpoints = list_checkpoints(context.run(source.run))
    if not checkpoints:
        raise ClientError(f"{source.key}: run {source.run} has no checkpoint yet; train it first")
    if source.checkpoint and not any(source.checkpoint in (str(c.iteration), c.name) for c in checkpoints):
        there = ", ".join(str(checkpoint.iteration) for checkpoint in checkpoints)
        raise ClientError(
            f"{source.key}: run {source.run} has no checkpoint of iteration {source.checkpoint}; it has: {there}"
        )


def _sources(spec: str) -> Iterator[Source]:
    try:
        document = json.loads(spec or "{}")
    except (ValueError, RecursionError):
        return  # refused where it is read
    sections = document if isinstance(document, dict) else {}
    for kind in ("evaluate", "export"):
        section = sections.get(kind)
        if isinstance(section, dict) and isinstance(section.get("run"), str):
            yield Source(section["run"], kind)
    given = sections
    for part in _TEACHER.split("."):
        given = given.get(part) if isinstance(given, dict) else None  # type: ignore[assignment]
    if given is not None:
        found = re.fullmatch(rf"({NAME.pattern})(?:@([0-9]{{1,8}}|[0-9]{{8}}-e[0-9]{{1,18}}))?", str(given))
        if found is None:
            raise ClientError(f"{_TEACHER}: expected RUN or RUN@ITERATION, found {shown(given)}")
        iteration = found[2] or ""
        yield Source(found[1], _TEACHER, str(int(iteration)) if iteration.isdecimal() else iteration)
