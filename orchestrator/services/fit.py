"""The fit of a job: whether it could ever start, and where, in one answer for plans, submissions, resumes and clones."""

from __future__ import annotations

from sqlalchemy.orm import Session

from orchestrator.control.controller import Controller
from orchestrator.control.snapshot import fit_in_queue
from orchestrator.domain.errors import ClientError
from orchestrator.domain.gang import GangSpec, gang_needs
from orchestrator.persistence.batch_models import JobQueue
from orchestrator.scheduling.fit import Fit
from orchestrator.services.context import UnknownQueue, queue_names
from orchestrator.services.permissions import Actor
from orchestrator.spec.compile import compile_definition
from orchestrator.spec.evaluations import automatic_evaluation, evaluation_settings, place_of


def fit_of(session: Session, actor: Actor, controller: Controller, queue: JobQueue, gang: GangSpec) -> Fit:
    """The answer of an idle queue to a job; a training whose automatic evaluations could never start has a problem, too."""
    found = fit_in_queue(session, controller.engines, queue, gang.shape)
    if found.problem or not (problem := _problem_of_evaluations(session, actor, controller, queue, gang)):
        return found
    return Fit(None, f"evaluation: {problem}")


def named_queue(session: Session, actor: Actor, name: str) -> JobQueue:
    """The queue of this name. Raises UnknownQueue."""
    queue = session.get(JobQueue, name)
    if queue is None or queue.deleting:
        raise UnknownQueue(name, queue_names(session, actor))
    return queue


def _problem_of_evaluations(
    session: Session, actor: Actor, controller: Controller, queue: JobQueue, gang: GangSpec
) -> str | None:
    """Why a training's automatic evaluations could never start in their queue; None where they could, or there are none."""
    try:
        evaluation = evaluation_settings(gang.spec)
        if evaluation is None:
            return None
        place = place_of(queue.name, evaluation)
        spec = automatic_evaluation("run", gang.spec or {}, place, evaluation, 1)
        definition = compile_definition(spec, gang.options.directory)
        shape = gang_needs(definition["nodeProperties"]).shape
        return fit_in_queue(session, controller.engines, named_queue(session, actor, place["queue"]), shape).problem
    except ClientError as error:
        return str(error)
