"""How a node ended that left no outcome in the store: as its engine saw it."""

from __future__ import annotations

from orchestrator.domain.job import NodeEnd
from orchestrator.engines.api import Cause, NodeStatus

_TAKEN = (Cause.SIGNAL, Cause.HOST_LOST, Cause.PREEMPTED)
"""Causes from outside: who does not see the supervisor any more can't tell its end from that of its host."""
_KILLED = 137
"""Exit code of a node that has none of its own, or that left with 0 and without the outcome that belongs to it."""


def seen_end(node: NodeStatus, is_native: bool, moment: float) -> NodeEnd:
    """The end of a node that left no outcome.

    Args:
        node: What its engine says; it has ended.
        is_native: Its job came from YAML. A job of the Batch API that is preempted has lost its host: AWS has no other word for it.
        moment: When it was seen (Unix time [s]).
    """
    code = node.exit_code or _KILLED
    if node.cause is Cause.PREEMPTED and not is_native:
        code = _KILLED
    words = node.words or "the supervisor died without an outcome"
    return NodeEnd(code, words, moment, lost=node.cause in _TAKEN)
