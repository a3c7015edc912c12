"""Actions on a job and on a checkpoint of its run: those of the commands, through the same functions of the API."""

from __future__ import annotations

from typing import Literal

from fastapi import Depends, Request, Response

from orchestrator.api.http.requests import actor_of, controller_of
from orchestrator.api.native import routes
from orchestrator.api.native.routes import permitted_job
from orchestrator.console.forms import Form, Question, done, sent_form
from orchestrator.console.routing import page_router
from orchestrator.domain.errors import ClientError
from orchestrator.domain.reasons import short_id
from orchestrator.services import clone as clones
from orchestrator.services import models
from orchestrator.services.chosen_checkpoints import CONFLICT, choose
from orchestrator.services.context import permitted_run
from orchestrator.services.derived_jobs import Kind, derive
from orchestrator.services.permissions import Operation
from orchestrator.services.resume import resume as resume_job
from orchestrator.services.spec_submission import Changes
from orchestrator.services.stop import stop as stop_jobs
from shared_store.volume.checkpoints import list_checkpoints
from shared_store.volume.layout import Run

router, _stored = page_router(), page_router(stored=True)
_Marked = int | Literal["best", "latest"] | None


@router.post("/jobs/{reference}/stop")
def stop(request: Request, reference: str, form: Form = Depends(sent_form)) -> Response:
    """Stop the job."""
    actor = actor_of(request)
    job, name, _, _ = _job(request, reference, Operation.TERMINATE_JOB)
    text = "A training saves a checkpoint before it ends, and can be resumed. A waiting job is cancelled."
    form.confirm(Question(f"Stop {name}?", text, "Stop"))
    refused = stop_jobs(controller_of(request), actor, [job], f"stopped in the console by {actor.name}")
    if job in refused:
        raise refused[job]
    return done(request, f"/jobs/{job}", f"{name} is asked to stop")


@router.post("/jobs/{reference}/save")
def save(request: Request, reference: str) -> Response:
    """Have a training save a checkpoint now."""
    job, _, _, _ = _job(request, reference, Operation.CHECKPOINT_JOB)
    message = routes.save_now(request, job)["answer"]
    if not message.startswith("checkpoint "):
        raise ClientError(message, CONFLICT)
    return done(request, f"/jobs/{job}", message)


@_stored.post("/jobs/{reference}/resume")
def resume(request: Request, reference: str, form: Form = Depends(sent_form)) -> Response:
    """Submit a job that continues the run."""
    actor = actor_of(request)
    run, directory = _run(request, reference, Operation.RESUME_RUN)
    marked = _checkpoint(form)
    chosen = choose(run, marked)
    newest = list_checkpoints(run)[-1:]
    if chosen and newest and chosen.name != newest[0].name:
        text = (
            f"The newest checkpoint is of iteration {newest[0].iteration}. Training after iteration "
            f"{chosen.iteration} no longer counts, and its curves end there."
        )
        form.confirm(Question(f"Continue from iteration {chosen.iteration}?", text, "Resume"))
    iteration = chosen.iteration if chosen and marked is not None else None
    changes = (*_changes(form), *(["train.accept_changed_robot=true"] if _accepts(form) else []))
    resumed = resume_job(controller_of(request), actor, run, Changes(iteration, changes, directory))
    return done(request, f"/jobs/{resumed['jobId']}", f"resumed {run.name} from iteration {resumed['iteration']}")


@_stored.post("/jobs/{reference}/clone")
def clone(request: Request, reference: str, form: Form = Depends(sent_form)) -> Response:
    """Submit a job that begins a new run with the weights of a checkpoint."""
    actor = actor_of(request)
    run, directory = _run(request, reference, Operation.CLONE_RUN)
    name = _named(form, "the new run")
    changes = Changes(_checkpoint(form), _changes(form), directory)
    cloned = clones.clone(controller_of(request), actor, run, name, changes)
    source = f"{cloned['parent']['run']}@{cloned['parent']['iteration']}"
    return done(request, f"/jobs/{cloned['jobId']}", f"cloned {source} as run {cloned['run']}")


def _add_derived(kind: Kind) -> None:
    """Add the route that submits a job of a kind, which reads a checkpoint, and leads to its page."""

    @_stored.post(f"/jobs/{{reference}}/{kind}")
    def derived(request: Request, reference: str, form: Form = Depends(sent_form)) -> Response:
        run, directory = _run(request, reference, Operation.READ_RUN)
        if (chosen := choose(run, _checkpoint(form))) is None:
            raise ClientError(f"run {run.name} has no checkpoint yet; train it first")
        section = {"checkpoint": chosen.iteration, **({"accept_changed_robot": True} if _accepts(form) else {})}
        job = derive(controller_of(request), actor_of(request), run, kind, section, directory)
        return done(request, f"/jobs/{job.id}", f"submitted {job.name}")


_add_derived("evaluate")
_add_derived("export")
_add_derived("record")


@_stored.post("/jobs/{reference}/register")
def register(request: Request, reference: str, form: Form = Depends(sent_form)) -> Response:
    """Keep an exported checkpoint as the next version of a model."""
    run, _ = _run(request, reference, Operation.REGISTER_MODEL)
    controller, actor = controller_of(request), actor_of(request)
    model = models.register(controller, actor, run.name, _named(form, "the model"), _checkpoint(form))
    message = f"registered {run.name}@{model.facts()['iteration']} as {model.name}@{model.version}"
    return done(request, f"/jobs/{reference}", message)


def _job(request: Request, reference: str, operation: Operation) -> tuple[str, str, str, str]:
    """Id, title, run and working directory of a job with which the caller may do this. Raises ClientError."""
    actor = actor_of(request)
    with controller_of(request).database.session() as session:
        job = permitted_job(session, actor, reference, operation)
        return job.id, f"{job.name} ({short_id(job.id)})", job.run, job.gang.options.directory


def _run(request: Request, reference: str, operation: Operation) -> tuple[Run, str]:
    """The run of a job, with which the caller may do this, and the job's working directory. Raises ClientError."""
    _, _, run, directory = _job(request, reference, Operation.READ_JOB)
    return permitted_run(controller_of(request), actor_of(request), run, operation), directory


def _checkpoint(form: Form) -> _Marked:
    """The marked checkpoint: an iteration, ``best``, or None for the newest. Raises ClientError."""
    marked = form.one("checkpoint")
    if marked in ("", "latest"):
        return None
    if marked == "best":
        return "best"
    if marked.isascii() and marked.isdecimal() and len(marked) < 10:
        return int(marked)
    raise ClientError(f"checkpoint {marked[:50]!r}: expected an iteration, best or latest")


def _accepts(form: Form) -> bool:
    """Whether a changed robot is accepted."""
    return bool(form.one("accept_changed_robot"))


def _changes(form: Form) -> tuple[str, ...]:
    """``key.path=value``, one a line."""
    return tuple(line.strip() for line in form.one("changes").splitlines() if line.strip())


def _named(form: Form, what: str) -> str:
    name = form.one("name").strip()
    if not 0 < len(name) <= 128:
        raise ClientError(f"give {what} a name, of at most 128 characters")
    return name


router.include_router(_stored)
