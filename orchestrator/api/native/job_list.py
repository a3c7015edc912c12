"""The list of jobs: those of all queues that the caller may see, found by state, queue and text, with the progress of each training."""

from __future__ import annotations

import threading
import time
from collections import OrderedDict
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from fastapi import APIRouter, Query, Request
from sqlalchemy import ColumnElement, case, func, select
from sqlalchemy.orm import Session, selectinload

from orchestrator.api.http.requests import actor_of, controller_of
from orchestrator.control.controller import Controller
from orchestrator.control.run_store import ObservedRun, facts_of
from orchestrator.control.store_calls import StoreSilent
from orchestrator.domain.errors import RequestError
from orchestrator.domain.job import EARLY, WAITING, RunTime, Status
from orchestrator.domain.reasons import Reason, array_of
from orchestrator.persistence.batch_models import Job, RunRecord
from orchestrator.persistence.job_pages import contains, count, place_of, read_page
from orchestrator.persistence.keyset import Cursor
from orchestrator.persistence.ownership import owner_of
from orchestrator.services.context import UnknownQueue, queue_names
from orchestrator.services.damaged_rows import DAMAGED, DamagedRow, reading
from orchestrator.services.permissions import Actor
from orchestrator.spec.evaluations import AUTOMATIC_TAG
from orchestrator.spec.model import KINDS
from shared_store.volume.files import DamagedFile
from shared_store.volume.layout import Run, Store
from shared_store.volume.metrics import finite, sampled

router = APIRouter()

JOBS_A_PAGE = 100
MOST_COUNTED = 5000
"""Jobs of a search that are counted, the newest."""
REWARDS = 40
"""Rewards of a job that tell its curve."""
_FRESH = 1.0
"""Seconds for which the curve of a job that is not over is not read again."""
_MOST_CURVES = 4096
_CHILDREN = 100
"""Greatest number of an array's children that are listed."""
_FAILED_FIRST = (
    *(Status.FAILED, Status.RUNNING, Status.STARTING, Status.RUNNABLE, Status.PENDING, Status.SUBMITTED),
    Status.SUCCEEDED,
)
"""The order of an array's children by state."""


@dataclass(frozen=True)
class JobSelection:
    """A filter of jobs: by states, by queue, and by a text in their name, id, run or owner. Empty fields mean all."""

    statuses: tuple[Status, ...] = ()
    queue: str = ""
    search: str = ""

    def conditions(self, session: Session) -> list[ColumnElement[bool]]:
        """Of the rows, by the text."""
        return [contains(session, text)] if (text := self.search.strip()) else []

    def queues(self, actor: Actor) -> Collection[str] | None:
        """Those whose jobs are wanted and may be seen by the actor; None: all."""
        visible = actor.queues
        if not self.queue:
            return visible
        return [self.queue] if visible is None or self.queue in visible else []


@router.get("/jobs")
def find_jobs(
    request: Request,
    status: list[Status] = Query(default=[], description="states; all where absent"),
    queue: str = Query(default="", max_length=128),
    search: str = Query(default="", max_length=200, description="part of a name, run or owner, or the start of an id"),
    after: str = Query(default="", max_length=200, description="`next` of a page: the jobs that are older"),
    before: str = Query(default="", max_length=200, description="`previous` of a page: the jobs that are newer"),
    most: int = Query(default=JOBS_A_PAGE, ge=1, le=JOBS_A_PAGE, alias="max"),
    progress: bool = Query(default=True, description="whether to read the progress of trainings in the store"),
) -> dict[str, Any]:
    """The jobs that the caller may see, the newest first, with the progress of trainings; ``total`` of them, and how many in each state.

    ``next`` and ``previous`` are the places of the pages beside this one; null where there is none.
    """
    controller, actor = controller_of(request), actor_of(request)
    if queue:
        with controller.database.session() as session:
            if queue not in (known := queue_names(session, actor)):
                raise UnknownQueue(queue, known, 404)
    return page_of_jobs(
        controller, actor, JobSelection(tuple(status), queue, search), most, after, before, with_progress=progress
    )


def page_of_jobs(
    controller: Controller,
    actor: Actor,
    selection: JobSelection,
    most: int = JOBS_A_PAGE,
    after: str = "",
    before: str = "",
    *,
    with_progress: bool = True,
) -> dict[str, Any]:
    """``jobs``, ``total`` and ``counts`` (by state, of all states) of the filter, and the places of the pages beside this one.

    A search counts its newest 5,000 jobs; ``areMore``: there may be others.

    Raises RequestError for a place that is none, and for two of them.
    """
    if after and before:
        raise RequestError("a page is after a place or before one, not both; leave one of them out")
    places = {"after": Cursor.read(after) if after else None, "before": Cursor.read(before) if before else None}
    queues = selection.queues(actor)
    with controller.database.session() as session:
        if conditions := selection.conditions(session):
            counts = count(session, queues, conditions, MOST_COUNTED)
        else:
            counts = controller.database.counts.by_status(queues)
        page = read_page(session, most, queues, selection.statuses, conditions, **places)
        rows = [_row(controller, session, job) for job in page.jobs]
    trainings = [training for _, training in rows if training is not None and with_progress]
    progress = _progress(controller, actor, trainings)
    states = selection.statuses or tuple(Status)
    return {
        "jobs": [{**row, "progress": progress.get(row["id"]), "isOwn": row["owner"] == actor.name} for row, _ in rows],
        "total": sum(counts.get(each, 0) for each in states),
        "counts": counts,
        "areMore": bool(conditions) and sum(counts.values()) == MOST_COUNTED,
        "next": None if page.is_last or not page.jobs else str(place_of(page.jobs[-1])),
        "previous": None if page.is_first or not page.jobs else str(place_of(page.jobs[0])),
    }


def ids_of(session: Session, actor: Actor, selection: JobSelection) -> list[str]:
    """The ids of all jobs that are wanted and not over."""
    active = [each for each in selection.statuses or tuple(Status) if not each.is_terminal]
    query = select(Job.id).where(Job.parent.is_(None), *selection.conditions(session), Job.status.in_(active))
    if (queues := selection.queues(actor)) is not None:
        query = query.where(Job.queue.in_(queues))
    return list(session.scalars(query.order_by(Job.created_at, Job.id)))


def kind_of(spec: Mapping[str, Any] | None) -> str:
    """The kind of a job, by its spec: one of :data:`orchestrator.spec.model.KINDS`, or ``command``."""
    return next((kind for kind in KINDS if (spec or {}).get(kind)), "command")


def ran(time: RunTime | None) -> dict[str, Any]:
    """How long a job or an attempt has run, as its part of an answer."""
    return {"ranSeconds": time and time.seconds, "runsSince": time and time.since}


def children_of(controller: Controller, session: Session, array: Job) -> list[dict[str, Any]]:
    """The children of an array: those that failed first, then those that run, wait and succeeded; at most 100."""
    order = case({str(status): place for place, status in enumerate(_FAILED_FIRST)}, value=Job.status)
    query = select(Job).where(Job.parent == array.id).order_by(order, Job.array_index).limit(_CHILDREN)
    return [
        {
            "index": child.array_index,
            "id": child.id,
            "status": child.status,
            "statusReason": controller.admission.reason(child).words or None,
            **ran(child.run_time),
        }
        for child in session.scalars(query.options(selectinload(Job.attempts)))
    ]


def reason_of(controller: Controller, session: Session, job: Job) -> Reason:
    """Why a job is in its state. For an array with waiting children: how many wait, and why the first one does."""
    own = controller.admission.reason(job)
    if job.kind != "array" or own.words != array_of(job.array_size):
        return own
    waiting = select(func.count(), func.min(Job.array_index)).where(Job.parent == job.id, Job.status.in_(EARLY))
    count, first = session.execute(waiting).one()
    child = session.get(Job, f"{job.id}:{first}") if count else None
    words = controller.admission.reason(child).words if child else ""
    if words in ("", WAITING):
        return Reason(words or own.words, own.aws)
    return Reason(f"{count} of {job.array_size} wait; child {first}: {words}", own.aws)


@dataclass(frozen=True)
class _Training:
    """A job that has begun to train."""

    job: Job
    main: int
    iterations: int


def _row(controller: Controller, session: Session, job: Job) -> tuple[dict[str, Any], _Training | None]:
    row = {
        "id": job.id,
        "name": job.name,
        "status": job.status,
        "statusReason": reason_of(controller, session, job).words or None,
        "queue": job.queue,
        "owner": job.owner,
        "run": job.run,
        "createdAt": job.created_at,
        "startedAt": job.started_at,
        "stoppedAt": job.stopped_at,
        **ran(job.run_time),
        "attempt": len(job.attempts),
        "attemptsAllowed": job.attempts_allowed,
        "arraySize": job.array_size,
        "automaticEvaluation": job.tags.get(AUTOMATIC_TAG),
    }
    try:
        with reading(job):
            gang = job.gang
            spec = gang.spec or {}
    except DamagedRow:
        return {**row, "kind": "command", "nodes": 0, "statusReason": DAMAGED}, None
    training = spec.get("train")
    iterations = training.get("iterations") if isinstance(training, Mapping) else None
    found = _Training(job, gang.main, iterations) if iterations and job.first_epoch is not None else None
    return {**row, "kind": kind_of(spec), "nodes": len(gang.nodes)}, found


def _progress(controller: Controller, actor: Actor, trainings: Sequence[_Training]) -> Mapping[str, dict[str, Any]]:
    """By job the progress of those trainings whose runs the caller may see; empty where the store does not answer."""
    if not trainings:
        return {}
    try:
        read, runs = controller.access.calls.call(partial(_read, actor, controller.access.store, trainings))
    except (StoreSilent, OSError):
        return {}
    hidden = set[str]()
    if actor.queues is not None:  # a job may continue a run of another queue
        with controller.database.session() as session:
            # one query instead of many
            _known = session.scalars(select(RunRecord).where(RunRecord.name.in_(list(runs)))).all()
            owners = {name: owner_of(session, run) for name, run in runs.items()}
        hidden = {name for name, owner in owners.items() if owner is None or not actor.may_see(owner)}
    shown = [each for each in trainings if each.job.run not in hidden]
    known = {each.job.id: _reported(controller, each, read[each.job.id]) for each in shown}
    return {job: progress for job, progress in known.items() if progress is not None}


def _read(
    actor: Actor, store: Store, trainings: Sequence[_Training]
) -> tuple[Mapping[str, Sequence[Mapping[str, Any]]], Mapping[str, ObservedRun]]:
    """By job its curve, and by name the runs whose owners must be known."""
    read = {each.job.id: curves.of(store.run(each.job.run), each.job) for each in trainings}
    names = {each.job.run for each in trainings} if actor.queues is not None else set()
    return read, {name: facts_of(store.run(name)) for name in names}


def _reported(controller: Controller, training: _Training, curve: Sequence[Mapping[str, Any]]) -> dict[str, Any] | None:
    """Progress of a training: the last report of its main node, and its curve; None before its first iteration."""
    job = training.job
    live = controller.bus.progress(job.id, job.attempts[-1].number, training.main) or {}
    last = curve[-1] if curve else {}
    iteration = int(max(finite(live.get("iteration")) or 0, finite(last.get("iteration")) or 0))
    if not iteration:
        return None
    rate = finite(live.get("steps_per_second")) or finite(last.get("steps_per_second"))
    rewards = [reward for each in curve if (reward := finite(each.get("reward"))) is not None]
    return {
        "iteration": iteration,
        "stepsPerSecond": rate,
        "reward": finite(last.get("reward")),
        "rewards": rewards,
        "iterations": training.iterations,
    }


class Curves:
    """A few records of each run's metrics, read once for a job that is over, and once a second for others. Any thread may call."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._known: OrderedDict[tuple[str, int | None], tuple[float, list[dict[str, Any]]]] = OrderedDict()

    def of(self, run: Run, job: Job) -> list[dict[str, Any]]:
        """Iteration, reward and rate of about 40 records, in order; none where they can't be read."""
        key, now = (str(run.path), job.stopped_at), time.monotonic()
        with self._lock:
            known = self._known.get(key)
            if known is not None and (job.is_terminal or now - known[0] < _FRESH):
                self._known.move_to_end(key)
                return known[1]
        try:
            records = sampled(run, REWARDS, job.attempts[-1].epoch if job.attempts else None)
        except (DamagedFile, OSError):
            records = []
        names = ("iteration", "reward", "steps_per_second")
        curve = [{name: each.get(name) for name in names} for each in records]
        with self._lock:
            self._known[key] = now, curve
            while len(self._known) > _MOST_CURVES:
                self._known.popitem(last=False)
        return curve


curves = Curves()
"""Shared by all requests of this process."""
