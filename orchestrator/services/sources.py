"""The sources of a job from YAML: runs that it evaluates, exports or shows, and the teacher that its policy imitates."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeVar

from orchestrator.control.controller import Controller
from orchestrator.domain.errors import ClientError
from orchestrator.domain.gang import GangSpec, NodeSpec
from orchestrator.persistence.batch_models import RunRecord
from orchestrator.persistence.own_models import RunUse
from orchestrator.persistence.ownership import owner_of
from orchestrator.services.chosen_checkpoints import check_evaluation, check_task, check_training
from orchestrator.services.context import Context, archived, permitted_run, release
from orchestrator.services.permissions import Operation
from shared_store.contract import plugins
from shared_store.contract.error_text import shown, unknown_iteration
from shared_store.volume.checkpoints import Checkpoint, DamagedCheckpoint, list_checkpoints
from shared_store.volume.contents import is_archived
from shared_store.volume.initial_weights import TeacherCopy, named_parent
from shared_store.volume.layout import NAME, Run

T = TypeVar("T")
_TEACHER = "train.rsl_rl.teacher_checkpoint"


@dataclass(frozen=True, order=True)
class SourceRun:
    """A run that a job reads."""

    run: str
    key: str
    """Of the spec, which names it."""
    checkpoint: str = ""
    """Of a teacher: the iteration or the name of its checkpoint; the newest one where empty."""
    reference: str = ""
    """Of a teacher: run and checkpoint as the spec has them."""

    @property
    def is_teacher(self) -> bool:
        """Whether the job's policy imitates it; else the job loads its task."""
        return self.key == _TEACHER


def sources_of(gang: GangSpec) -> list[SourceRun]:
    """The sources that a job reads; each node reads the spec of its own environment. Raises ClientError."""
    nodes = {id(node): node for node in gang.nodes}
    return sorted({source for node in nodes.values() for source in _sources(node)})


def uses_of(job: str, gang: GangSpec) -> list[RunUse]:
    """Rows of the runs that a job needs beside its own. Raises ClientError."""
    parent = gang.nodes[gang.main].environment.get("MUSTER_PARENT", "").partition("@")[0]
    needed = {parent, *(source.run for source in sources_of(gang))}
    return [RunUse(job_id=job, run=run) for run in sorted(needed) if NAME.fullmatch(run)]


class TeacherNeeded(ClientError):
    """The job's run has to hold a copy of these weights: :func:`with_teacher` makes it and submits again."""

    def __init__(self, run: str, checkpoint: Checkpoint) -> None:
        super().__init__(f"{_TEACHER}: the weights of run {run} are not copied yet; submit it again", 503)
        self.run, self.checkpoint = run, checkpoint


def check_sources(context: Context, gang: GangSpec, is_waiting: bool) -> TeacherNeeded | None:
    """Check that the runs exist and have the files that the job reads, unless it waits for another one that makes them.

    The caller must be allowed to read them. A run that holds its teacher already needs the teacher's run no more. Raises ClientError.

    Returns:
        The teacher's weights, where the job's run has to hold a copy of them.
    """
    store, spec = context.controller.access.store, gang.spec
    check_training(store, spec, context.read)
    teacher = None
    mains = set(_sources(gang.nodes[gang.main]))
    for source in sources_of(gang):
        is_teacher = source.is_teacher
        if is_teacher and context.read(("held", source), partial(_is_held, context, gang, source)):
            continue
        context.controller.access.users.check(source.run)
        if not is_waiting:
            try:
                found = partial(permitted_run, context.controller, context.actor, source.run, Operation.SUBMIT_JOB)
                version = context.controller.access.users.version(source.run)
                run = context.read(("find", source.run, version), found)
                if not is_teacher and context.read(("archived", source.run, version), partial(is_archived, run)):
                    raise archived(source.run)
            except ClientError as error:
                raise ClientError(f"{source.key}: {error}" if is_teacher else str(error), error.status) from None
        if context.actor.queues is not None:
            owner = owner_of(context.session, context.found(source.run))
            if owner is None or not context.actor.may_see(owner):  # another's is as one that does not exist yet
                context.actor.check(Operation.SUBMIT_JOB, RunRecord(name=source.run, queue=""))
        if not is_teacher and not is_waiting:
            context.read(("task", source.run), partial(check_task, context.run(source.run)))
        if source.key in plugins.evaluating() and not is_waiting:
            evaluated = partial(check_evaluation, store, context.run(source.run), spec or {}, source.key)
            context.read((source.key, source.run), evaluated)
        if is_teacher and not is_waiting:
            needed = TeacherNeeded(
                source.run, context.read(("weights", source), partial(_checkpoint, context.run(source.run), source))
            )
            teacher = needed if source in mains else teacher  # the main node's is the one that all ranks take
    return teacher


def with_teacher(controller: Controller, submit: Callable[[TeacherCopy | None], T]) -> T:
    """Submit a job; the weights that its policy will imitate are copied first, without holding the database.

    Raises ClientError.

    Args:
        submit: Submits it with a copy, or raises :class:`TeacherNeeded`.
    """
    try:
        return submit(None)
    except TeacherNeeded as error:
        needed = error
    if shortage := controller.access.shortage():
        raise ClientError(f"{shortage}; the run has a copy of its teacher's weights", 503)
    copy = TeacherCopy(controller.access.store, controller.access.peers.id, needed.run, needed.checkpoint)
    tidy = copy.discard

    def end() -> None:
        tidy()  # waits for a copy that hangs
        release(controller, copy)

    try:
        controller.access.calls.call(partial(copy.copy, "teacher"), works=True)
        answer = submit(copy)
        tidy = copy.close
        return answer
    except DamagedCheckpoint as error:
        raise ClientError(f"{_TEACHER}: run {needed.run}: {error}") from None
    except OSError as error:
        raise ClientError(f"{_TEACHER}: the weights can't be copied ({error.strerror or error})", 503) from None
    finally:
        controller.access.calls.later(end)


def hold_teacher(context: Context, run: str, needed: TeacherNeeded) -> None:
    """Give the copy of its teacher to the run of a job that is being submitted.

    Raises TeacherNeeded where there is no copy yet, StoreNeeded, DamagedFile, OSError.
    """
    copy = context.teacher
    if copy is None or copy.teacher != needed.run:
        raise needed
    if context.making is not None:
        context.read("teacher", partial(copy.publish, context.making.hidden))
    else:
        context.publish(run, copy, partial(copy.publish, context.run(run).path))


def _is_held(context: Context, gang: GangSpec, source: SourceRun) -> bool:
    """Whether the run has the teacher: in a checkpoint of its own, in the weights with which it begins, or as a copy."""
    if context.making is not None:
        return _has_teacher(context.making.source, source)
    named = gang.options.run
    if not named:
        return False
    run = context.run(named)
    if list_checkpoints(run):
        return True
    with contextlib.suppress(OSError, ValueError, DamagedCheckpoint):
        if (parent := named_parent(run)) and _has_teacher(parent, source):
            return True
    return any(_is_meant(each, source) for each in list_checkpoints(run.teacher(source.run)))


def _has_teacher(weights: Checkpoint, source: SourceRun) -> bool:
    settings = weights.manifest.get("settings")
    return isinstance(settings, dict) and settings.get("teacher_checkpoint") == source.reference


def _is_meant(checkpoint: Checkpoint, source: SourceRun) -> bool:
    return source.checkpoint in ("", str(checkpoint.iteration), checkpoint.name)


def _checkpoint(run: Run, source: SourceRun) -> Checkpoint:
    """The newest checkpoint that a teacher's reference means. Raises ClientError."""
    checkpoints = list_checkpoints(run)
    if not checkpoints:
        raise ClientError(f"{source.key}: run {source.run} has no checkpoint yet; train it first")
    meant = [checkpoint for checkpoint in checkpoints if _is_meant(checkpoint, source)]
    if not meant:
        known = (checkpoint.iteration for checkpoint in checkpoints)
        raise ClientError(f"{source.key}: {unknown_iteration(source.run, source.checkpoint, known)}")
    return meant[-1]


def _sources(node: NodeSpec) -> Iterator[SourceRun]:
    try:
        sections = node.spec or {}
    except (ValueError, RecursionError):
        return  # refused where it is read
    for kind in (*plugins.evaluating(), "export", "record", "render"):
        section = sections.get(kind)
        if isinstance(section, dict) and isinstance(section.get("run"), str):
            yield SourceRun(section["run"], kind)
    value: Any = sections
    for part in _TEACHER.split("."):
        value = value.get(part) if isinstance(value, dict) else None
    if value is not None:
        found = re.fullmatch(rf"({NAME.pattern})(?:@([0-9]{{1,8}}|[0-9]{{8}}-e[0-9]{{1,18}}))?", str(value))
        if found is None:
            raise ClientError(f"{_TEACHER}: expected RUN or RUN@ITERATION, found {shown(value)}")
        iteration = found[2] or ""
        yield SourceRun(found[1], _TEACHER, str(int(iteration)) if iteration.isdecimal() else iteration, str(value))
