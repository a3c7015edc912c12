"""What a request brings with it: the controller that it is for, who has sent it, and the key under which it may be repeated."""

from __future__ import annotations

from typing import Annotated

from fastapi import Header, Request

from orchestrator.control.controller import Controller
from orchestrator.services.permissions import Actor

IDEMPOTENCY_HEADER = "X-Muster-Idempotency-Key"
"""Makes it safe to repeat a submission whose answer was lost."""
IdempotencyKey = Annotated[str | None, Header(alias=IDEMPOTENCY_HEADER)]
"""Parameter of a route that submits a job."""


def actor_of(request: Request) -> Actor:
    """Who has sent the request, as the guard has found."""
    actor: Actor = request.state.actor
    return actor


def controller_of(request: Request) -> Controller:
    """The controller that the application serves."""
    controller: Controller = request.app.state.controller
    return controller
