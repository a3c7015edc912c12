"""The native API of webhooks: who is told when jobs end, and to try one. For keys with all queues: the operator's."""

from __future__ import annotations

from typing import Any

from fastapi import APIRouter, Request

from orchestrator.api import permissions
from orchestrator.api.errors import ClientError
from orchestrator.api.permissions import Operation
from orchestrator.deliveries import Deliveries
from shared_store.wording import nearest

router = APIRouter()


def _deliveries(request: Request) -> Deliveries:
    deliveries: Deliveries = request.app.state.deliveries
    return deliveries


@router.get("/webhooks")
def list_webhooks(request: Request) -> list[dict[str, Any]]:
    """The webhooks of the controller's ``--webhooks`` file, without paths and secrets: how many messages wait, and which were given up."""
    permissions.check_all_queues(Operation.READ_WEBHOOKS)
    deliveries = _deliveries(request)
    with request.app.state.controller.database.session() as session:
        return deliveries.described(session)


@router.post("/webhooks/{name}/test")
def test_webhook(request: Request, name: str) -> dict[str, Any]:
    """Send a sample once, signed like any message; ``problem`` is null where the receiver accepted it."""
    permissions.check(Operation.TEST_WEBHOOK)
    permissions.check_all_queues(Operation.TEST_WEBHOOK)
    deliveries = _deliveries(request)
    webhook = deliveries.webhooks.get(name)
    if webhook is None:
        known = list(deliveries.webhooks)
        hint = nearest(name, known, "" if known else "this controller has none; start it with --webhooks FILE")
        raise ClientError(f"webhook {name[:100]} does not exist; {hint}", 404)
    return deliveries.test(webhook)
