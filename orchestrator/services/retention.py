"""Retention at the request of an actor: what the rules would take, taking it, and archiving or deleting one run."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any

from orchestrator.control.controller import Controller
from orchestrator.control.retention import RunNeeded
from orchestrator.control.retention_facts import Requester
from orchestrator.domain.errors import ClientError
from orchestrator.domain.retention import age_of
from orchestrator.persistence.keyset import Cursor
from orchestrator.services.context import permitted_run
from orchestrator.services.permissions import Actor, Operation
from shared_store.volume import contents

_A_PART = 2.0
"""Seconds of an answer: the rest of a pass comes with the next ones."""


def archive(controller: Controller, actor: Actor, name: str, *, archived: bool) -> None:
    """Archive a run, or take it out again.

    Raises:
        ClientError: There is no such run, or it is not the actor's.
        RunNeeded: A job that has not ended uses it.
    """
    run = permitted_run(controller, actor, name, Operation.ARCHIVE_RUN)
    with controller.retention.alone(run.name):
        if controller.retention.stored.facts([run.name])[run.name] is None:
            raise ClientError(f"run {run.name} was deleted a moment ago", 404)
        if archived and (job := controller.retention.open_job(run.name)):
            raise RunNeeded(
                f"run {run.name} is not archived, since job {job} has not ended; stop it first: muster stop {job}"
            )
        if archived:
            contents.archive(run, actor.name)
        else:
            contents.unarchive(run)


def delete(controller: Controller, actor: Actor, name: str) -> dict[str, Any]:
    """Delete a run with all that it holds, where nothing needs it; its size, and where in the trash is what can't be removed.

    Raises:
        ClientError: There is no such run, or it is not the actor's.
        RunNeeded: Something needs it.
    """
    run = permitted_run(controller, actor, name, Operation.DELETE_RUN)
    controller.writes.check(adds=False)
    return controller.retention.delete(run.name, Requester(actor.name, actor.queues))


def next_part(controller: Controller, actor: Actor, after: str, older_than: str, *, take: bool) -> dict[str, Any]:
    """The next part of a pass over the actor's jobs and runs.

    Args:
        after: ``next`` of the part before; empty at first.
        older_than: Age in place of the rules' default, such as ``30d``; empty as the rules say.
        take: Whether to take what the rules let go, rather than only to name it.

    Raises:
        ClientError: A malformed place or age.
        Refusal: The actor may not take anything.
    """
    if take:
        actor.check(Operation.TAKE_GARBAGE)
        controller.writes.check(adds=False)
    by = Requester(actor.name, actor.queues)
    place = Cursor.read(after) if after else Cursor()
    try:
        older = age_of(older_than) if older_than else None
    except ValueError as error:
        raise ClientError(f"older_than: {error}") from None
    if not after:
        controller.retention.stored.refresh()  # others may have changed the store
    found: list[dict[str, Any]] = []
    deadline = time.monotonic() + _A_PART
    while True:
        rules = controller.retention.rules()
        rules = rules if older is None else replace(rules, default=older)
        steps, following = controller.retention.step(place, rules, take=take, by=by)
        found += steps
        if following is None or time.monotonic() > deadline:
            return {"runs": found, "next": None if following is None else str(following)}
        place = following
