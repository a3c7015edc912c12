"""The end of a node: by its outcome in the store, else as its engine saw it."""

from __future__ import annotations

from orchestrator.domain.job import NodeEnd
from orchestrator.engines.api import Cause, NodeStatus
from orchestrator.persistence.models import Node
from shared_store.layout import Run
from shared_store.outcomes import read_outcome

_TAKEN = (Cause.SIGNAL, Cause.HOST_LOST, Cause.PREEMPTED)
"""Causes from outside: who does not see the supervisor any more can't tell its end from that of its host."""
_KILLED = 137
"""Exit code of a node that has none of its own, or that left with 0 and without the outcome that belongs to it."""


def node_end(run: Run, record: Node, node: NodeStatus, is_native: bool, moment: int) -> tuple[NodeEnd, int]:
    """The end of a node, and its time (Unix time [ms]). Raises OSError.

    Args:
        run: Of its job.
        record: Its row.
        node: Its status by its engine; it has ended.
        is_native: Its job came from YAML.
        moment: When that was seen (Unix time [ms]).
    """
    outcome = read_outcome(run, record.job_id, record.attempt, record.index)
    if outcome is None:
        return seen_end(node, is_native, moment / 1000), moment
    # a supervisor sees that its rank was killed; only the engine knows for what
    starved = outcome.signal == "SIGKILL" and node.cause is Cause.OUT_OF_MEMORY
    end = NodeEnd(
        outcome.exit_code,
        node.words if starved else outcome.reason,
        outcome.error.time if outcome.error else outcome.ended,
        outcome.error.message if outcome.error else None,
        asked=outcome.asked,
    )
    return end, min(moment, int(outcome.ended * 1000))


def seen_end(node: NodeStatus, is_native: bool, moment: float) -> NodeEnd:
    """The end of a node that left no outcome.

    Args:
        node: Its status by its engine; it has ended.
        is_native: Its job came from YAML. A job of the Batch API that is preempted has lost its host: AWS has no other word for it.
        moment: When it was seen (Unix time [s]).
    """
    code = node.exit_code or _KILLED
    if node.cause is Cause.PREEMPTED and not is_native:
        code = _KILLED
    words = node.words or "the supervisor died without an outcome"
    return NodeEnd(code, words, moment, lost=node.cause in _TAKEN)
