"""The context of an operation, and look-up of the objects that a request names."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from functools import partial
from itertools import islice
from typing import Any, TypeVar

from sqlalchemy import select
from sqlalchemy.orm import Session

from orchestrator.control.controller import Controller
from orchestrator.control.run_store import ObservedRun, facts_of
from orchestrator.domain import reasons
from orchestrator.domain.errors import ClientError, RequestError
from orchestrator.domain.job import Status
from orchestrator.persistence.batch_models import (
    ComputeEnvironment,
    Job,
    JobDefinition,
    JobQueue,
    RunRecord,
    SchedulingPolicy,
)
from orchestrator.persistence.ownership import owner_of
from orchestrator.persistence.queries import find_job
from orchestrator.services.arns import plain_name
from orchestrator.services.damaged_rows import DamagedRow
from orchestrator.services.permissions import Actor, JobsOf, Operation
from shared_store.contract.error_text import nearest
from shared_store.volume.initial_weights import NewRun, TeacherCopy, WeightsCopy
from shared_store.volume.layout import Run, StoreError

_COMPARED = 1000
"""Names of runs among which the nearest to an unknown one is looked for."""


T = TypeVar("T")
Row = TypeVar("Row", ComputeEnvironment, SchedulingPolicy)
_KINDS: dict[type, str] = {ComputeEnvironment: "Compute environment", SchedulingPolicy: "Scheduling policy"}
Known = dict[Hashable, Callable[[], Any]]
"""What was read of the store, by key: each returns it, or raises what the read raised."""


class StoreNeeded(RequestError):
    """A call needs to know something of the store: :func:`with_store` reads that and makes the call again."""

    def __init__(self, key: Hashable, body: Callable[[], Any]) -> None:
        super().__init__("the store was not read yet")
        self.key, self.body = key, body


def with_store(controller: Controller, call: Callable[[Known], T]) -> T:
    """Carry out a call that may need to know something of the store. That is read while neither the database nor a lock is held.

    Raises what the call raises, StoreSilent.
    """
    known: Known = {}
    while True:
        try:
            return call(known)
        except StoreNeeded as needed:
            known[needed.key] = controller.access.calls.call(partial(_outcome, needed.body))


def release(controller: Controller, copy: WeightsCopy) -> None:
    """Let others write the run that :meth:`Context.publish` gave this copy: it stands in the database, or the copy was taken back."""
    for name in [name for name, by in list(controller.access.beginning.items()) if by is copy]:
        del controller.access.beginning[name]


def _outcome(body: Callable[[], T]) -> Callable[[], T]:
    """What returns the result of ``body``, or raises its error."""
    try:
        result = body()
    except Exception as raised:
        error = raised

        def fail() -> T:
            raise error

        return fail
    return lambda: result


@dataclass(frozen=True)
class Context:
    """One call."""

    session: Session
    controller: Controller
    actor: Actor
    idempotency_key: str | None = None
    making: NewRun | None = None
    """The run that a submission makes, of a clone."""
    teacher: TeacherCopy | None = None
    """The weights that the submitted job's policy will imitate, copied already (:func:`orchestrator.services.sources.with_teacher`)."""
    known: Known = field(default_factory=dict)
    """What was read of the store for the call."""

    def read(self, key: Hashable, body: Callable[[], T]) -> T:
        """What ``body`` reads of the store; ``key`` tells it apart. Raises StoreNeeded where it was not read yet, else what it raised."""
        if key not in self.known:
            raise StoreNeeded(key, body)
        found: T = self.known[key]()
        return found

    def publish(self, name: str, copy: WeightsCopy, body: Callable[[], Any]) -> None:
        """Have ``body`` put a copy into the run, which nobody else gets until :func:`release`. Raises StoreNeeded, and what it raises."""
        self.controller.access.beginning[name] = copy
        self.read(("publish", name), body)

    def found(self, name: str) -> ObservedRun:
        """The run of that name, as it is in the store. Raises ClientError where no run can have it, StoreNeeded."""
        run = self.run(name)
        return self.read(("run", name), lambda: facts_of(run))

    def named(self, kind: type[Row], reference: str) -> Row:
        """The row of this name or ARN. Raises ClientError."""
        words = _KINDS[kind]
        if (row := self.session.get(kind, plain_name(reference, words.lower().replace(" ", "-")))) is None:
            raise ClientError(f"{words} {reference[:300]} does not exist")
        return row

    def queue(self, reference: str, *, deleting: bool = False) -> JobQueue:
        """The queue of this name or ARN; one that is being deleted only where ``deleting``. Raises ClientError."""
        queue = self.session.get(JobQueue, plain_name(reference, "job-queue"))
        if queue is None or (queue.deleting and not deleting):
            raise UnknownQueue(reference, queue_names(self.session, self.actor))
        return queue

    def definition(self, reference: str) -> JobDefinition:
        """The active definition of this ARN, ``name:revision`` or name. Raises ClientError.

        A name alone is the newest revision that the actor has registered, else that of the first one who has registered the name:
        nobody can put a definition of theirs in the place of another's.
        """
        name, _, revision = plain_name(reference, "job-definition").partition(":")
        query = select(JobDefinition).where(JobDefinition.name == name, JobDefinition.status == "ACTIVE")
        if revision:
            if not (revision.isascii() and revision.isdigit() and len(revision) < 10):
                raise ClientError(f"Job definition {reference[:300]}: the revision must be a number")
            found = self.session.scalars(query.where(JobDefinition.revision == int(revision))).first()
        else:
            of_name = select(JobDefinition.owner).where(JobDefinition.name == name).order_by(JobDefinition.revision)
            newest = query.order_by(JobDefinition.revision.desc()).limit(1)
            owners = self.actor.name, self.session.scalars(of_name.limit(1)).first()
            of_owners = (newest.where(JobDefinition.owner.is_not_distinct_from(owner)) for owner in owners)
            found = next((each for query in of_owners if (each := self.session.scalars(query).first())), None)
        if found is None:
            raise ClientError(f"Job definition {reference[:300]} does not exist or is not active")
        return found

    def definition_of(self, job: Job) -> JobDefinition:
        """The definition of a job, active or not. Raises DamagedRow where the database has lost it."""
        definition = named_definition(self.session, job.definition)
        if definition is None:
            raise DamagedRow(job)
        return definition

    def run(self, name: str) -> Run:
        """The run of that name, whether it exists or not. Raises ClientError where no run can have it."""
        try:
            return self.controller.access.store.run(name)
        except StoreError as error:
            raise ClientError(str(error)) from None

    def reason(self, job: Job) -> str | None:
        """The job's ``statusReason`` in the AWS Batch API; None before it has one."""
        return self.controller.admission.reason(job).aws or None


class UnknownQueue(ClientError):
    """A request names a queue that does not exist; ``known``: those that the caller may see."""

    def __init__(self, name: str, known: Sequence[str], status: int = 400) -> None:
        available = ", ".join(known[:10]) or "none"
        super().__init__(f"Job queue {name[:300]} does not exist; available: {available}", status)


def named_definition(session: Session, arn: str) -> JobDefinition | None:
    """The definition with this ARN, active or not; None where the database has lost it."""
    name, _, revision = plain_name(arn, "job-definition").partition(":")
    return session.get(JobDefinition, (name, int(revision)))


def queue_names(session: Session, actor: Actor) -> list[str]:
    """The queues whose jobs the actor may see, by name."""
    names = session.scalars(select(JobQueue.name).where(JobQueue.deleting.is_(False)).order_by(JobQueue.name))
    return [name for name in names if actor.may_see(JobsOf(name))]


def find_run(controller: Controller, actor: Actor, name: str) -> Run:
    """The run called ``name``. Raises ClientError (404) naming its job, where that never started, or the nearest run; StoreSilent."""
    run = _run(controller, name)
    if run.description() is None:
        raise _absent(controller, actor, name)
    return run


@contextmanager
def using(controller: Controller, *runs: str, cites: bool = True) -> Iterator[None]:
    """A block in which nobody deletes these runs; ``cites``: afterwards something in the store may need them. Raises RunInUse."""
    with ExitStack() as stack:
        for run in runs:
            stack.enter_context(controller.access.users.using(run))
        if cites:  # before the runs are released, so that retention looks at the store again before it takes one
            stack.callback(controller.retention.stored.refresh)
        yield


def archived(run: str) -> ClientError:
    """The refusal to add something to an archived run."""
    return ClientError(
        f"run {run} is archived, and nothing is added to it; take it out first: muster runs archive {run} --undo", 409
    )


def _run(controller: Controller, name: str) -> Run:
    try:
        return controller.access.store.run(name)
    except StoreError as error:
        raise ClientError(str(error)) from None


def _absent(controller: Controller, actor: Actor, name: str) -> ClientError:
    """The actor sees no run called ``name``; what it may see is named. Raises StoreSilent."""
    controller.access.check()
    with controller.database.session() as session:
        query = select(Job).where(Job.run == name, Job.first_epoch.is_(None)).order_by(Job.created_at.desc())
        job = session.scalars(query.limit(1)).first()
        if job is not None and actor.may_see(job) and job.kind == "array":
            return ClientError(f"run {name} does not exist: {_runs_of_array(session, job)}", 404)
        if job is not None and actor.may_see(job):
            over = Status(job.status).is_terminal
            what = "never started; submit it again" if over else f"has not started yet: it is {job.status}"
            return ClientError(f"run {name} does not exist: job {reasons.named(job.name, job.id)} {what}", 404)
        named = find_job(session, name, actor.queues, actor.name)
        if named is not None and named.kind == "array":
            return ClientError(f"{name} is a job, not a run; {_runs_of_array(session, named)}", 404)
        if named is not None:
            return ClientError(f"{name} is a job, not a run; its run is {named.run}", 404)
    runs = [each.name for each in visible_runs(controller, actor, most=_COMPARED)]
    others = "`muster runs` lists the runs" if runs else "no run exists yet"
    hint = nearest(name, runs, others, cutoff=0.5)  # a run's name has an id at its end
    return ClientError(f"run {name} does not exist in {controller.access.store.path}; {hint}", 404)


def _runs_of_array(session: Session, array: Job) -> str:
    """The runs of an array's children, with the one to name first: of those that started, one that failed if there is one."""
    failed_first = (Job.status != Status.FAILED, Job.array_index)
    query = select(Job).where(Job.parent == array.id, Job.first_epoch.is_not(None)).order_by(*failed_first).limit(1)
    if (first := session.scalars(query).first()) is None:
        such = "none of them has started"
    else:
        such = f"name one, such as {first.run}" + (", which failed" if first.status == Status.FAILED else "")
    last = (array.array_size or 1) - 1
    return f"job {reasons.named(array.name, array.id)} is an array; its children have the runs {array.run}-0 to {array.run}-{last}; {such}"


def permitted_run(controller: Controller, actor: Actor, name: str, operation: Operation) -> Run:
    """The run called ``name``, where the actor may do this to it; another's is as if it did not exist. Raises ClientError."""
    owner = owner_of_run(controller, _run(controller, name))
    if owner is not None:
        if not actor.may_see(owner):
            raise _absent(controller, actor, name)
        actor.check(operation, owner)
    return find_run(controller, actor, name)


def owner_of_run(controller: Controller, run: Run) -> RunRecord | None:
    """:func:`owner_of`, for a run that is not read yet. Raises OSError."""
    found = facts_of(run)
    with controller.database.session() as session:
        return owner_of(session, found)


def visible_runs(
    controller: Controller,
    actor: Actor,
    after: str = "",
    most: int | None = None,
    search: str = "",
    among: Callable[[Run], bool] = lambda run: True,
) -> list[Run]:
    """The runs of the store that the actor may see, by name.

    Args:
        after: Those behind this name.
        most: At most so many.
        search: Those with this text in their names.
        among: Those of which this is true; it may read the store.
    """
    restricted = actor.queues is not None
    part = search.lower()
    found = controller.access.store.runs(
        after, None if restricted else most, lambda run: part in run.name.lower() and among(run)
    )
    if not restricted:
        return found
    with controller.database.session() as session:
        recorded = {record.name: record for record in session.scalars(select(RunRecord))}
    owned = ((run, recorded.get(run.name) or owner_of_run(controller, run)) for run in found)
    return list(islice((run for run, owner in owned if owner is not None and actor.may_see(owner)), most))
