"""The rows by which retention decides: references to runs and jobs, and the facts about jobs."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from typing import Any

from sqlalchemy import ColumnElement, and_, case, delete, false, not_, or_, select
from sqlalchemy.orm import Session, aliased

from orchestrator.domain.job import TERMINAL
from orchestrator.domain.retention import JobFacts, RetentionReference, RetentionRules
from orchestrator.persistence.batch_models import Attempt, Dependency, Job, JobDefinition, Node, RunRecord
from orchestrator.persistence.job_counts import ArrayRole, note_rows
from orchestrator.persistence.own_models import AutomaticEvaluation, RunUse, WebhookDelivery

_SUBMITTED = {"MUSTER_DIRECTORY", "MUSTER_SPEC"}
"""Variables of a definition which `muster submit` and the like compile (:mod:`orchestrator.spec.compile`)."""


def jobs_of_runs(
    session: Session, runs: Collection[str], rules: RetentionRules, moment: int
) -> dict[str, list[JobFacts]]:
    """All jobs of these runs, by run, as they are at a moment (Unix time [ms]). The jobs of an array are due together."""
    found: dict[str, list[JobFacts]] = {run: [] for run in runs}
    other = aliased(Job)
    of_array = or_(other.parent == Job.id, other.id == Job.parent)
    is_kept = (
        select(other.id).where(of_array, or_(other.stopped_at.is_(None), not_(due(rules, moment, other)))).exists()
    )
    is_due = case(
        (and_(due(rules, moment), not_(is_kept)), True), else_=False
    )  # where the time is missing, neither is known
    query = select(Job.id, Job.run, Job.status, is_due).where(Job.run.in_(runs))
    for job, run, status, due_now in session.execute(query.order_by(Job.created_at, Job.id)):
        found[run].append(JobFacts(job, status not in TERMINAL, due_now))
    return found


def references(session: Session, runs: Collection[str]) -> Iterator[RetentionReference]:
    """What needs these runs, or jobs of them."""
    is_open = Job.status.not_in(TERMINAL)
    uses = select(RunUse.run, Job.id).join(Job, Job.id == RunUse.job_id)
    for used, job in session.execute(uses.where(RunUse.run.in_(runs), is_open)):
        yield RetentionReference("run", used, f"job {job} needs it")
    evaluated = select(AutomaticEvaluation.run, AutomaticEvaluation.job).where(AutomaticEvaluation.open)
    for evaluation in session.execute(evaluated.where(AutomaticEvaluation.run.in_(runs))):
        yield RetentionReference("run", evaluation.run, f"job {evaluation.job} evaluates it")
    ids = select(Job.id).where(Job.run.in_(runs))
    waits = select(Dependency.on_id, Dependency.job_id).join(Job, Job.id == Dependency.job_id)
    for job, waiting in session.execute(waits.where(Dependency.on_id.in_(ids), is_open)):
        yield RetentionReference("job", job, f"job {waiting} waits for it")
    array = aliased(Job)
    of_array = select(Job.id, array.id).join(array, array.id == Job.parent).where(Job.run.in_(runs))
    for job, parent in session.execute(of_array.where(array.status.not_in(TERMINAL))):
        yield RetentionReference("job", job, f"it belongs to array {parent}, which has not ended")


def due(rules: RetentionRules, moment: int, job: type[Job] = Job) -> ColumnElement[bool]:
    """Which jobs may go at a moment (Unix time [ms]), as far as rules and times tell."""
    queue_of = job.queue.concat("")  # so that SQLite uses the index by time, which has the queue, and no index by queue
    each = [
        and_(queue_of == queue, job.stopped_at <= moment - age)
        for queue, age in rules.queues.items()
        if age is not None
    ]
    others = queue_of.in_(rules.others)
    if rules.default is not None:
        each.append(and_(others, job.stopped_at <= moment - rules.default))
    elif (limit := rules.batch_limit(moment)) is not None:
        each.append(and_(others, job.from_yaml.is_(False), job.stopped_at <= limit))
    return or_(false(), *each)


def forget_jobs(session: Session, ids: Collection[str]) -> set[str]:
    """Delete the history of these jobs, but for those that a job waits for by now, and arrays with other children; returns what went.

    Definitions that nothing else needs go with them.
    """
    open_jobs = select(Job.id).where(Job.status.not_in(TERMINAL))
    needed = select(Dependency.on_id).where(Dependency.on_id.in_(ids), Dependency.job_id.in_(open_jobs))
    child = aliased(Job)
    # the children of an array have their definition from it
    has_others = select(child.id).where(child.parent == Job.id, child.id.not_in(ids)).exists()
    query = select(Job.id, Job.parent, Job.kind, Job.queue, Job.status, Job.definition).where(Job.id.in_(ids))
    found = session.execute(query.where(Job.status.in_(TERMINAL), Job.id.not_in(needed), not_(has_others))).all()
    gone = [row.id for row in found]
    for row in found:
        note_rows(session, row.queue, row.status, ArrayRole.of(row.parent, row.kind), -1)
    session.execute(delete(WebhookDelivery).where(WebhookDelivery.job.in_(gone), WebhookDelivery.next_at.is_(None)))
    session.execute(
        delete(AutomaticEvaluation).where(AutomaticEvaluation.training.in_(gone), AutomaticEvaluation.open.is_(False))
    )
    for table, column in (
        (Node, Node.job_id),
        (Attempt, Attempt.job_id),
        (Dependency, Dependency.job_id),
        (RunUse, RunUse.job_id),
        (Job, Job.id),
    ):
        session.execute(delete(table).where(column.in_(gone)))
    _forget_definitions(session, {row.definition for row in found})
    return set(gone)


def forget_owners(session: Session, runs: Collection[str]) -> None:
    """Forget the owners of runs that are not in the store any more and that no job is about to create."""
    named = select(Job.run).where(Job.run.in_(runs))
    session.execute(delete(RunRecord).where(RunRecord.name.in_(runs), RunRecord.name.not_in(named)))


def _forget_definitions(session: Session, arns: Collection[str]) -> None:
    """Delete those of these definitions that no job has, and that no user needs: a submission of Muster's made it, or it is deregistered.

    The newest revision that a client registered stays, so that no number is given twice.
    """
    used = set(session.scalars(select(Job.definition).where(Job.definition.in_(arns)).distinct()))
    for arn in set(arns) - used:
        name, _, revision = arn.rpartition("job-definition/")[2].rpartition(":")
        found = session.get(JobDefinition, (name, int(revision))) if revision.isdecimal() else None
        if found is None:
            continue
        newest = select(JobDefinition.revision).where(JobDefinition.name == name)
        is_newest = session.scalar(newest.order_by(JobDefinition.revision.desc()).limit(1)) == found.revision
        if is_of_submission(found.document) or (found.status == "INACTIVE" and not is_newest):
            session.delete(found)


def is_of_submission(definition: Mapping[str, Any]) -> bool:
    """Whether `muster submit`, `run` or the like has made it."""
    ranges = (definition.get("nodeProperties") or {}).get("nodeRangeProperties") or []
    environments = ((each.get("container") or {}).get("environment") or [] for each in ranges)
    names = {pair.get("name") for environment in environments for pair in environment}
    return names >= _SUBMITTED
