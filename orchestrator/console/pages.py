"""Pages: templates, headers, the parts of all pages, and errors that a person can read."""

from __future__ import annotations

from dataclasses import dataclass
from http import HTTPStatus
from itertools import product
from pathlib import Path
from typing import Any

from fastapi import Request, Response
from fastapi.responses import HTMLResponse
from jinja2 import Environment, FileSystemLoader, StrictUndefined, select_autoescape

from orchestrator.api.http.access import Access
from orchestrator.api.http.auth import error_response, session_of
from orchestrator.api.http.requests import actor_of
from orchestrator.console import assets, formats
from orchestrator.domain.reasons import short_id, title
from orchestrator.services.permissions import Actor
from shared_store import __version__
from shared_store.contract.error_text import counted
from shared_store.contract.plugins import PluginError, load, plugins

POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; connect-src 'self'; frame-src 'self'; "
    "form-action 'self'; base-uri 'none'; frame-ancestors 'none'; require-trusted-types-for 'script'; trusted-types fragments"
)
"""Content-Security-Policy of every page: its own files and nothing else, nothing inline; of its scripts, only ``static/live.js`` makes markup,
of the fragments that the server rendered."""
_HEADERS = {
    "Content-Security-Policy": POLICY,
    "Cache-Control": "no-store",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Permissions-Policy": "camera=(), microphone=(), geolocation=(), usb=()",
}
THEME = "muster-theme"
"""Cookie with ``light`` or ``dark``, where a person chose one."""


@dataclass(frozen=True)
class NavigationEntry:
    """An entry of the navigation."""

    label: str
    path: str


NAVIGATION = (
    NavigationEntry("Jobs", "/"),
    NavigationEntry("Runs", "/runs"),
    NavigationEntry("Models", "/models"),
    *(NavigationEntry(label, path) for plugin in plugins().values() for label, path in plugin.navigation),
    NavigationEntry("Queues & compute", "/queues"),
    NavigationEntry("Keys", "/keys"),
    NavigationEntry("Submit", "/submit"),
)


def _template_folders() -> list[Path]:
    """The folder of the console's templates, and those of plug-ins. Raises PluginError: one is missing, or hides another's template."""
    found = [Path(__file__).parent / "templates"]
    for name, package in ((name, plugin.templates) for name, plugin in plugins().items() if plugin.templates):
        folders = [Path(place) / "templates" for place in getattr(load(package), "__path__", ())]
        added = [str(each.relative_to(folder)) for folder in folders for each in folder.glob("**/*") if each.is_file()]
        if not added:
            raise PluginError(
                f"plug-in {name}: templates: {package} has no folder templates with files; install it again"
            )
        for template, before in product(sorted(added), found):
            if (before / template).exists():
                raise PluginError(f"plug-in {name}: the template {template} already exists, in {before}; rename it")
        found += folders
    return found


templates = Environment(
    loader=FileSystemLoader(_template_folders()),
    autoescape=select_autoescape(default=True, default_for_string=True),
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
    auto_reload=False,
)
templates.globals |= {"asset": assets.url, "version": __version__}
_FORMATS = (
    "age",
    "amounts",
    "cost",
    "count",
    "duration",
    "interval",
    "moment",
    "nodes",
    "ran",
    "size",
    "spark",
    "with_error",
)
templates.filters |= {name: getattr(formats, name) for name in _FORMATS} | {
    "counted": counted,
    "short_id": short_id,
    "title_of": title,
}


def render(request: Request, template: str, status: int = 200, frame: str = "", **values: Any) -> HTMLResponse:
    """A page of ``templates/``.

    ``frame``: the one other origin whose page it shows in a frame.
    """
    text = templates.get_template(template).render(shared(request) | values)
    headers = dict(_HEADERS)
    if frame:
        headers["Content-Security-Policy"] = POLICY.replace("frame-src 'self'", f"frame-src 'self' {frame}")
    return HTMLResponse(text, status, headers)


def shared(request: Request) -> dict[str, Any]:
    """What all pages show: who is looking, the navigation, the theme, the form's token."""
    actor, theme = actor_of(request), request.cookies.get(THEME)
    return {
        "actor": actor,
        "may_change": may_change(actor),
        "navigation": _navigation(actor),
        "here": request.url.path,
        "theme": theme if theme in ("light", "dark") else "",
        "form_token": form_token(request),
        "has_session": bool(session(request)),
    }


def may_change(actor: Actor) -> bool:
    """Whether the caller may change anything at all: a read-only key sees no buttons that would be refused."""
    return not actor.read_only


def form_token(request: Request) -> str:
    """The token that forms send back; see :mod:`orchestrator.console.forms`."""
    access: Access = request.app.state.access
    return access.form_token(session(request))


def session(request: Request) -> str:
    """The session of the request; empty where it has none."""
    access: Access = request.app.state.access
    token = session_of(request.headers, request.scope["server"][1])
    return token if access.session(token) is not None else ""


def _navigation(actor: Actor) -> list[NavigationEntry]:
    """The entries, without those whose pages would be refused."""
    refused = set() if may_change(actor) else {"/submit"}
    if actor.queues is not None:
        refused.add("/keys")
    return [entry for entry in NAVIGATION if entry.path not in refused]


def wants_page(request: Request) -> bool:
    """Whether the request is for a page, and not from one of the console's scripts."""
    return "text/html" in request.headers.get("accept", "")


def failure(request: Request, message: str, status: int, kind: str = "ClientException") -> Response:
    """An error, as a page or for a script."""
    if not wants_page(request):
        return error_response(message, status, kind)
    title = HTTPStatus(status).phrase if status in set(HTTPStatus) else "Error"
    return render(request, "error.html", status, title=title, message=message)
