"""The ending of a node as its status, from an exit code and last words."""

from __future__ import annotations

from orchestrator.engines.api import Cause, NodePhase, NodeStatus


def ended(address: str, exit_code: int | None, words: str = "", gpus: tuple[str, ...] = ()) -> NodeStatus:
    """A node that has ended: unobserved (None), by a signal (128 + n), or by itself."""
    cause = Cause.HOST_LOST if exit_code is None else Cause.SIGNAL if exit_code > 128 else Cause.EXIT
    return NodeStatus(NodePhase.ENDED, address, words, cause, exit_code, gpus)
