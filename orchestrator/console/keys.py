"""The page of access keys and their permissions: create a key, whose secret is shown once, and delete one."""

from __future__ import annotations

from typing import Any

from fastapi import Depends, Request, Response

from orchestrator.api.http.requests import actor_of, controller_of
from orchestrator.api.native.key_routes import create_key, delete_key, is_writable, list_keys
from orchestrator.console.forms import Form, Question, done, sent_form
from orchestrator.console.live import LiveParts, Table, stream
from orchestrator.console.pages import render
from orchestrator.console.routing import page_router
from orchestrator.services.arns import here
from orchestrator.services.context import queue_names

router = page_router()
_INTERVAL = 1.0
"""Seconds between two polls of the keys."""


@router.get("/keys")
def keys(request: Request) -> Response:
    """The list."""
    with controller_of(request).database.session() as session:
        queues = queue_names(session, actor_of(request))
    return render(request, "keys.html", **_parts(request), queues=queues, writable=is_writable(request))


@router.get("/keys/stream")
def keys_stream(request: Request) -> Response:
    """The changes in the list, as events."""
    live = LiveParts(request, "keys_live.html", writable=is_writable(request))
    return stream(request, lambda: live.changes(_parts(request)), _INTERVAL)


def _parts(request: Request) -> dict[str, Any]:
    """The keys by their names. Raises ClientError."""
    return {"keys": Table((key.name, key) for key in list_keys(request))}


@router.post("/keys/create")
def create(request: Request, form: Form = Depends(sent_form)) -> Response:
    """Create a key and show it; the response is a page for scripts as well, since the secret must not be kept anywhere."""
    name = form.one("name").strip()
    if not list_keys(request):
        text = "From now on everybody needs a key, you too: copy its secret from the next page, and log in with it."
        form.confirm(Question(f"Create the first key, {name}?", text, "Create"))
    share = form.one("share").strip() or None
    key = create_key(request, name, tuple(form.every("queue")), form.one("read_only") == "yes", share)
    return render(request, "key.html", key=key, url=str(request.base_url).rstrip("/"), region=here().region)


@router.post("/keys/delete")
def delete(request: Request, form: Form = Depends(sent_form)) -> Response:
    """Delete a key."""
    actor = actor_of(request)
    name = form.one("name")
    notes = ["It is refused from the next request on."]
    if actor.name == f"key {name}":
        notes.append("It is your own key: you will be logged out.")
    if {key.name for key in list_keys(request)} == {name}:
        notes.append(
            "It is the last key: until one is created on the server's machine, only MUSTER_TOKEN gives access."
        )
    form.confirm(Question(f"Delete key {name}?", " ".join(notes), "Delete"))
    delete_key(request, name)
    return done(request, "/keys", f"deleted key {name}")
