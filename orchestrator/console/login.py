"""Login with a key of the API, and logout."""

from __future__ import annotations

import re

from fastapi import Depends, Request, Response
from fastapi.responses import RedirectResponse

from orchestrator.api.http.access import SESSION, Access
from orchestrator.api.http.auth import LOGIN, LOGOUT, cookie_name
from orchestrator.api.http.limits import RateLimit
from orchestrator.console.forms import Form, sent_form
from orchestrator.console.pages import render, session
from orchestrator.console.routing import page_router
from orchestrator.services.permissions import Refusal

router = page_router()


@router.get(LOGIN)
def ask(request: Request, next: str = "/") -> Response:
    """The page for the key; a visitor who needs none, or is logged in, is redirected."""
    access: Access = request.app.state.access
    if not access.demanded() or session(request):
        return RedirectResponse(_own(next), 303)
    return render(request, "login.html", next=_own(next), problem="")


@router.post(LOGIN)
def log_in(request: Request, form: Form = Depends(sent_form)) -> Response:
    """Open a session for a key; no cookie and no page keeps the key itself."""
    access: Access = request.app.state.access
    limit: RateLimit = request.app.state.limit
    address = _own(form.one("next", "/"))
    try:
        token = access.sign_in(form.one("key").strip())
    except Refusal:
        wait = limit.refusal_of_failures(request.client.host if request.client else "unknown")
        problem = wait or f"this key is unknown; {access.way_in()}"
        return render(request, "login.html", 429 if wait else 403, next=address, problem=problem)
    response = RedirectResponse(address, 303)
    secure = request.url.scheme == "https"
    name = cookie_name(request.scope["server"][1])
    response.set_cookie(name, token, max_age=SESSION, httponly=True, samesite="strict", secure=secure, path="/")
    return response


@router.post(LOGOUT)
def log_out(request: Request) -> Response:
    """Close the session."""
    access: Access = request.app.state.access
    access.sign_out(session(request))
    response = RedirectResponse(LOGIN, 303)
    response.delete_cookie(cookie_name(request.scope["server"][1]), httponly=True, samesite="strict", path="/")
    return response


def _own(address: str) -> str:
    """The address if it is a path of this server, else ``/``: a login must not lead to another server."""
    is_own = re.fullmatch(r"/(?![/\\])[!-\[\]-~]*", address)  # no other host, no backslash, no control character
    return address if is_own and not address.startswith(LOGIN) else "/"
