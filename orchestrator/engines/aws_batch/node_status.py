"""The status of a gang's node at AWS, by what AWS says of it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from orchestrator.engines.api import Cause, Handle, NodePhase, NodeStatus
from orchestrator.engines.toolkit.endings import ended
from shared_store.contract.error_text import counted


def waiting(handle: Handle, index: int, status: str, detail: Mapping[str, Any], parent: Mapping[str, Any]) -> str:
    """Why a node has not been started, in words a person can act on."""
    said = detail.get("statusReason") or parent.get("statusReason") or ""
    if said and status != "STARTING":
        return f"AWS Batch: {said}"
    count, queue = handle.nodes, str(handle.facts["queue"]).rpartition("/")[2]
    if status == "STARTING":
        return f"AWS Batch starts node {index}: its instance pulls the image"
    if parent["status"] == "RUNNING":
        return f"AWS Batch starts node {index} now that the main node runs"
    return (
        f"AWS Batch gets {counted(count, 'instance')} for queue {queue} ({status}); "
        "if that lasts, see `muster aws status` for limits and the account's quota of vCPUs"
    )


def waits(status: str, address: str, why: str) -> NodeStatus:
    """A node that AWS has not started; ``status``: SUBMITTED, PENDING, RUNNABLE or STARTING."""
    return NodeStatus(NodePhase.STARTING if status == "STARTING" else NodePhase.QUEUED, address, why)


def node_ended(address: str, code: int | None, reason: str, not_started: bool = False) -> NodeStatus:
    """A node that has ended, by its exit code and AWS's reason: of memory and lost hosts AWS tells in words alone."""
    if not_started:
        return NodeStatus(NodePhase.ENDED, address, reason, Cause.CANNOT_START)
    if reason.startswith("OutOfMemoryError"):
        return NodeStatus(NodePhase.ENDED, address, reason, Cause.OUT_OF_MEMORY, code)
    if code is None and reason and not reason.startswith("Host EC2"):
        return NodeStatus(NodePhase.ENDED, address, reason)  # AWS does not say
    return ended(address, code, reason)
