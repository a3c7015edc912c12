"""Submitting a job: a wizard for a task, plain YAML, and a review of both before anything is submitted."""

from __future__ import annotations

import secrets
from collections.abc import Sequence
from dataclasses import asdict
from functools import partial
from typing import Any

from fastapi import Depends, Query, Request, Response
from fastapi.responses import JSONResponse

from orchestrator.api.http.requests import actor_of, controller_of
from orchestrator.api.native import plan_routes, routes
from orchestrator.api.native.plan_routes import PlanRequest
from orchestrator.api.turns import Turns
from orchestrator.console.forms import Form, done, sent_form
from orchestrator.console.pages import render
from orchestrator.console.routing import page_router
from orchestrator.console.submit_fields import FieldGroup, document, filled, form_of, forms, groups, tasks, written
from orchestrator.console.submit_help import SOURCE, SubmissionProblem, help_at, problem_of
from orchestrator.domain.errors import ClientError, SpecError
from orchestrator.services import permissions
from orchestrator.services.context import UnknownQueue, queue_names
from orchestrator.services.permissions import Operation
from orchestrator.services.spec_submission import submit_spec
from orchestrator.services.texts import with_texts
from orchestrator.spec.compile import compile_definition
from orchestrator.spec.file import from_text
from orchestrator.spec.model import Spec
from shared_store.contract.error_text import unknown_task

router, _stored = page_router(), page_router(stored=True)

BEGINNING = """\
name: my-job
queue: default
nodes: 1
resources: {cpus: 1, gpus: 0, memory: 2GiB}
train:
  task: Cartpole
  worlds: 128
  iterations: 100
"""
_LARGEST = 192 << 10
"""Bytes of a form's YAML: of a file's text of at most 140,000 characters, with its indentation, and of the rest of the job."""
_turns = Turns("the files of other jobs are being tried")
"""Each is tried in a process of its own."""
_checks = Turns("other jobs are being checked")


@router.get("/submit")
def choose(request: Request) -> Response:
    """The page on which the task is chosen."""
    _check_permission(request)
    kinds: dict[str, dict[str, str]] = {title: {} for title in (*(form.title for form in forms()), "Train a task")}
    for name, about in tasks().items():
        form = form_of(name)
        kinds[form.title if form else "Train a task"][name] = about
    return render(request, "submit.html", kinds=kinds)


@_stored.get("/submit/task/{task}")
def wizard(request: Request, task: str) -> Response:
    """The wizard for a task."""
    return _wizard(request, task, _groups(request, task), None)


@_stored.post("/submit/task/{task}")
def wizard_again(request: Request, task: str, form: Form = Depends(sent_form)) -> Response:
    """The wizard with the fields as they were filled in before."""
    return _wizard(request, task, filled(form, _groups(request, task)), None)


@router.get("/submit/yaml")
def plain(request: Request, job: str = Query(default="", max_length=200)) -> Response:
    """The YAML editor; with ``job`` the spec of that job, to submit a changed one."""
    text = BEGINNING
    if job:
        detail, controller = routes.job_detail(request, job), controller_of(request)
        if not detail["spec"]:
            raise ClientError(f"job {job} was not submitted with a job YAML")
        text = written(controller.access.calls.call(partial(with_texts, controller, detail["run"], detail["spec"])))
    return _editor(request, text, None)


@router.post("/submit/yaml")
def plain_again(request: Request, form: Form = Depends(sent_form)) -> Response:
    """The YAML editor with a text: the wizard's, or the one written before."""
    return _editor(request, _text(request, form)[0], None)


@router.post("/submit/check")
def check(request: Request, form: Form = Depends(sent_form)) -> Response:
    """The YAML of the filled fields, its problem, and help for a line; ``whole`` also tries the texts of files."""
    _check_permission(request)
    text, _ = _text(request, form)
    spec, problem = _checked(request, text, form.one("whole") == "yes")
    line = form.one("line")
    return JSONResponse(
        {
            "yaml": text,
            "problem": problem and asdict(problem),
            "notes": list(spec.notes) if spec else [],
            "help": help_at(text, int(line)) if line.isascii() and line.isdigit() and len(line) < 7 else None,
        }
    )


@_stored.post("/submit/review")
def review(request: Request, form: Form = Depends(sent_form)) -> Response:
    """The YAML with the hosts on which its nodes would start; or the form again, with its problem."""
    _check_permission(request)
    text, task = _text(request, form)
    spec, problem = _checked(request, text, whole=True)
    plan: dict[str, Any] = {}
    unplanned = ""
    if spec is not None:
        body = PlanRequest(definition=compile_definition(spec, ""), queue=spec.queue)
        problem = _unfit(request, spec, body)
        try:
            plan = {} if problem else plan_routes.plan(request, body)
        except ClientError as error:
            unplanned = str(error)
    if spec is None or problem is not None:
        if task:
            return _wizard(request, task, filled(form, _groups(request, task)), problem, 400)
        return _editor(request, text, problem, 400)
    once, fields = secrets.token_urlsafe(16), form.repeated()
    shown: dict[str, Any] = {"spec": spec, "text": text, "plan": plan, "unplanned": unplanned}
    return render(request, "submit_review.html", **shown, task=task, fields=fields, once=once)


@_stored.post("/submit")
def submit(request: Request, form: Form = Depends(sent_form)) -> Response:
    """Submit the job of a YAML, as ``muster submit`` does; a form that is sent again leads to the job that it made."""
    _check_permission(request)
    spec, problem = _checked(request, _lines(form.one("yaml")), whole=True)
    if spec is None:
        assert problem is not None
        raise ClientError(f"{SOURCE}{f':{problem.line}' if problem.line else ''}: {problem.message}")
    controller, actor = controller_of(request), actor_of(request)
    job, is_new = submit_spec(controller, actor, spec, "", idempotency_key=form.one("once") or None)
    beginning = "submitted" if is_new else "this form has already submitted"
    return done(request, f"/jobs/{job.id}", f"{beginning} {job.name} as {job.id[:8]}")


def _unfit(request: Request, spec: Spec, body: PlanRequest) -> SubmissionProblem | None:
    """Why the job could never start."""
    try:
        problem = plan_routes.fits(request, body)["problem"]
    except permissions.Refusal:
        raise
    except UnknownQueue as error:
        return SubmissionProblem(str(error), "queue")
    except ClientError as error:
        return SubmissionProblem(str(error))
    if problem and problem.startswith("evaluation: "):
        return SubmissionProblem(problem.removeprefix("evaluation: "), "evaluation")
    return SubmissionProblem(problem, "resources.cpus") if problem else None


def _checked(request: Request, text: str, whole: bool) -> tuple[Spec | None, SubmissionProblem | None]:
    """The spec of a text, or its problem.

    A learner's code runs here only for keys with all queues, though it is in a sandbox: for other keys its text is checked here, and
    the job's ranks try it.
    """
    tries = whole and actor_of(request).queues is None
    store = str(controller_of(request).access.store.path)
    try:
        with (_turns if tries else _checks).turn():
            return from_text(text, SOURCE, whole=tries, store=lambda: store), None
    except SpecError as error:
        return None, problem_of(str(error), text)


def _text(request: Request, form: Form) -> tuple[str, str]:
    """The YAML of a form, and the wizard's task; that is empty where the form has the YAML itself."""
    if not (task := form.one("task")):
        return _lines(form.one("yaml")), ""
    found = filled(form, _groups(request, task))
    with _checks.turn():
        return written(document(task, found)), task


def _lines(text: str) -> str:
    """The text with its own line ends: a form sends lines that end with CR and LF. Raises ClientError where it is too large."""
    if (size := len(text.encode())) > _LARGEST:
        raise ClientError(f"{SOURCE}: the text has {size:,} bytes, and may have {_LARGEST:,}; shorten it", 413)
    return text.replace("\r\n", "\n")


def _groups(request: Request, task: str) -> list[FieldGroup]:
    _check_permission(request)
    if task not in tasks():
        raise ClientError(unknown_task(task, tasks()), 404)
    with controller_of(request).database.session() as session:
        return groups(task, queue_names(session, actor_of(request)))


def _check_permission(request: Request) -> None:
    actor_of(request).check(Operation.SUBMIT_JOB)


def _wizard(
    request: Request, task: str, found: Sequence[FieldGroup], problem: SubmissionProblem | None, status: int = 200
) -> Response:
    form = form_of(task)
    names, missing = form.names(request) if form else ([], "")
    fields = [each.name for group in found for each in group.fields]
    wrong = [name for name in fields if problem and f"{problem.key}.".startswith(f"{name}.")]
    return render(
        request,
        "submit_task.html",
        status,
        task=task,
        about=tasks()[task],
        groups=found,
        text=written(document(task, found)),
        names=names,
        missing=missing,
        problem=problem,
        wrong_name=max(wrong, key=len, default=""),
        tries=actor_of(request).queues is None,
    )


def _editor(request: Request, text: str, problem: SubmissionProblem | None, status: int = 200) -> Response:
    _check_permission(request)
    return render(request, "submit_yaml.html", status, text=text, problem=problem, help=help_at(text, 1))


router.include_router(_stored)
