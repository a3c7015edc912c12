"""The page of access keys and their permissions: create a key, whose secret is shown once, and delete one."""

from __future__ import annotations

from collections.abc import Sequence

from fastapi import Depends, Request, Response

from orchestrator.api.http.requests import actor_of, controller_of
from orchestrator.api.native.key_routes import create_key, delete_key, is_writable, list_keys
from orchestrator.console import formats as words
from orchestrator.console.forms import Form, Question, done, sent_form
from orchestrator.console.live import ServerSentEvent, TableRows, stream
from orchestrator.console.pages import render
from orchestrator.console.routing import page_router
from orchestrator.services.arns import here
from orchestrator.services.context import queue_names

router = page_router()
_INTERVAL = 1.0
"""Seconds between two looks at the keys."""


@router.get("/keys")
def keys(request: Request) -> Response:
    """The list."""
    actor = actor_of(request)
    rows = _rows(request)
    with controller_of(request).database.session() as session:
        queues = queue_names(session, actor)
    blank = dict.fromkeys(("name", "id", "rights", "share", "created", "own"), "")
    return render(
        request, "keys.html", rows=list(rows.values()), blank=blank, queues=queues, writable=is_writable(request)
    )


@router.get("/keys/stream")
def keys_stream(request: Request) -> Response:
    """The changes in the list, as events."""
    table = TableRows()

    def changes() -> Sequence[ServerSentEvent]:
        return table.changes(_rows(request), {})

    return stream(request, changes, _INTERVAL)


def _rows(request: Request) -> dict[str, dict[str, str]]:
    """The texts of each key's row, by its name. Raises ClientError."""
    actor = actor_of(request)
    own = actor.name
    return {
        key.name: {
            "name": key.name,
            "id": key.access_key_id,
            "rights": key.rights,
            "share": key.share,
            "created": words.moment(key.created_at),
            "own": "you" if own == f"key {key.name}" else "",
        }
        for key in list_keys(request)
    }


@router.post("/keys/create")
def create(request: Request, form: Form = Depends(sent_form)) -> Response:
    """Make a key and show it; the answer is a page for scripts as well, since the secret must not be kept anywhere."""
    name = form.one("name").strip()
    if not list_keys(request):
        text = "From now on everybody needs a key, you too: copy its secret from the next page, and log in with it."
        form.confirm(Question(f"Make the first key, {name}?", text, "Make it"))
    share = form.one("share").strip() or None
    key = create_key(request, name, tuple(form.every("queue")), form.one("read_only") == "yes", share)
    return render(request, "key.html", key=key, url=str(request.base_url).rstrip("/"), region=here().region)


@router.post("/keys/delete")
def delete(request: Request, form: Form = Depends(sent_form)) -> Response:
    """Delete a key."""
    actor = actor_of(request)
    name = form.one("name")
    there = {key.name for key in list_keys(request)}
    notes = ["Whoever uses it is refused from the next request on."]
    if actor.name == f"key {name}":
        notes.append("It is your own: you are logged out.")
    if there == {name}:
        notes.append(
            "It is the last one: until a key is made on the server's machine, only MUSTER_TOKEN lets anybody in."
        )
    form.confirm(Question(f"Delete key {name}?", " ".join(notes), "Delete"))
    delete_key(request, name)
    return done(request, "/keys", f"deleted key {name}")
