"""The native API's routes for webhooks: list the receivers of messages about ended jobs, and test one. For keys with all queues."""

from __future__ import annotations

from typing import Any

from fastapi import APIRouter, Request

from orchestrator.api.http.requests import actor_of, controller_of
from orchestrator.control.deliveries import Deliveries
from orchestrator.domain.errors import ClientError
from orchestrator.services.chosen_checkpoints import CONFLICT
from orchestrator.services.permissions import Operation
from shared_store.contract.error_text import nearest

router = APIRouter()


@router.get("/webhooks")
def list_webhooks(request: Request) -> list[dict[str, Any]]:
    """The webhooks of the controller, without paths and secrets: how many messages wait, and which were given up."""
    actor = actor_of(request)
    actor.check_all_queues(Operation.READ_WEBHOOKS)
    deliveries: Deliveries | None = request.app.state.deliveries
    if deliveries is None:
        return []
    with controller_of(request).database.session() as session:
        return deliveries.described(session)


@router.post("/webhooks/{name}/test")
def test_webhook(request: Request, name: str) -> dict[str, Any]:
    """Send a sample once, signed like any message; ``problem`` is null where the receiver accepted it."""
    actor = actor_of(request)
    actor.check(Operation.TEST_WEBHOOK)
    actor.check_all_queues(Operation.TEST_WEBHOOK)
    deliveries: Deliveries | None = request.app.state.deliveries
    if deliveries is None or not deliveries.webhooks:
        raise ClientError("this controller has no webhooks; start it with: muster serve --webhooks FILE", CONFLICT)
    webhook = deliveries.webhooks.get(name)
    if webhook is None:
        raise ClientError(f"webhook {name[:100]} does not exist; {nearest(name, list(deliveries.webhooks))}", 404)
    return deliveries.test(webhook)
