"""Forms: their token, questions before something is lost, and the response to a change.

A form works without scripts (a page asks, a page responds); with ``static/forms.js`` the same addresses respond in JSON, and the question
is a dialog on the page.
"""

from __future__ import annotations

import hmac
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, TypeVar
from urllib.parse import parse_qs

from fastapi import Request, Response
from fastapi.responses import JSONResponse, RedirectResponse
from pydantic import BaseModel, ValidationError
from starlette.concurrency import run_in_threadpool

from orchestrator.console.pages import form_token, render, wants_page
from orchestrator.domain.errors import ClientError
from orchestrator.services.permissions import Refusal
from shared_store.contract.error_text import explain, path_of

TOKEN = "form_token"
"""The field of a form that other web pages can't know."""
_LARGE = 16 << 10
"""Bytes of a body that would keep the event loop busy for some milliseconds."""
_LARGEST_JOB = 600 << 10
"""Bytes of a form with a job: 192 KiB of YAML, of which each may take three, and the other fields."""
_MOST_FIELDS = 5000
_Body = TypeVar("_Body", bound=BaseModel)
_OPEN = "/login"
"""Path of the login form, which is sent without a session; browsers tell its origin."""


@dataclass(frozen=True)
class Question:
    """A question to a person before something is lost."""

    title: str
    text: str
    label: str
    """Label of the button that confirms."""


@dataclass(frozen=True)
class Form:
    """The fields of a form, by name."""

    fields: Mapping[str, list[str]]

    def one(self, name: str, default: str = "") -> str:
        """The last value of this name."""
        return self.fields.get(name, [default])[-1]

    def every(self, name: str) -> list[str]:
        """All values of this name."""
        return list(self.fields.get(name, []))

    def repeated(self) -> list[tuple[str, str]]:
        """Names and values for another form that sends the same."""
        return [(name, value) for name, values in self.fields.items() for value in values if name != TOKEN]

    def confirm(self, question: Question) -> None:
        """Continue only where the person was asked and confirmed. Raises Unconfirmed."""
        if self.one("confirmed") != "yes":
            raise Unconfirmed(question, self)


class Unconfirmed(Exception):
    """A change that needs the person's confirmation first."""

    def __init__(self, question: Question, form: Form) -> None:
        super().__init__(question.title)
        self.question, self.form = question, form

    def response(self, request: Request) -> Response:
        """The question, as a page or for the dialog."""
        if not wants_page(request):
            return JSONResponse({"question": asdict(self.question)}, 409)
        fields, action = self.form.repeated(), request.url.path
        return render(request, "confirm.html", 409, question=self.question, fields=fields, action=action)


async def sent_form(request: Request) -> Form:
    """The fields of an ``application/x-www-form-urlencoded`` body, parsed once, a large one in a thread. Raises ClientError."""
    if (form := getattr(request.state, "form", None)) is None:
        body = await request.body()
        if request.url.path.startswith("/submit") and len(body) > _LARGEST_JOB:
            raise ClientError(f"the form has {len(body):,} bytes, and may have {_LARGEST_JOB:,}; shorten the job", 413)
        form = _parsed(body) if len(body) < _LARGE else await run_in_threadpool(_parsed, body)
        request.state.form = form
    parsed: Form = form
    return parsed


def _parsed(body: bytes) -> Form:
    try:
        return Form(parse_qs(body.decode(), keep_blank_values=True, max_num_fields=_MOST_FIELDS, errors="strict"))
    except ValueError:
        raise ClientError(f"the form can't be read: it has more than {_MOST_FIELDS} fields, or is not UTF-8") from None


async def check_form(request: Request) -> None:
    """Refuse a change that does not come from a form of this console. Raises Refusal."""
    if request.method in ("GET", "HEAD") or request.url.path == _OPEN:
        return
    token = (await sent_form(request)).one(TOKEN)
    if not hmac.compare_digest(token.encode(), form_token(request).encode()):
        raise Refusal("AccessDeniedException", "the session has expired; reload the page")


def body_of(kind: type[_Body], fields: Mapping[str, Any]) -> _Body:
    """A request's body made of a form's texts. Raises ClientError that names the first wrong field."""
    try:
        return kind.model_validate(fields)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        raise ClientError(f"{'.'.join(map(str, path_of(first)))}: {explain(first)}") from None


def done(request: Request, path: str, message: str = "") -> Response:
    """The response to a change: the page at ``path``, and a message there."""
    if not wants_page(request):
        return JSONResponse({"location": path, "message": message})
    return RedirectResponse(path, 303)
