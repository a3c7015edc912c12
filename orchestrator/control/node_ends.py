"""The ends of nodes: each by its outcome in the store, else as its engine saw it."""

from __future__ import annotations

from orchestrator.domain.job import NodeEnd
from orchestrator.engines.api import Cause, NodeStatus
from shared_store.volume.node_outcomes import Outcome

_TAKEN = (Cause.SIGNAL, Cause.HOST_LOST, Cause.PREEMPTED)
"""Causes from outside: who does not see the supervisor any more can't tell its end from that of its host."""
_KILLED = 137
"""Exit code of a node whose own exit code is not known."""


def node_end(outcome: Outcome | None, node: NodeStatus, is_native: bool, moment: int) -> tuple[NodeEnd, int]:
    """The end of a node, and its time (Unix time [ms]).

    Args:
        outcome: What its supervisor has left; None for one that has left nothing.
        node: Its status by its engine.
        is_native: Its job came from YAML.
        moment: When its end was seen (Unix time [ms]).
    """
    if outcome is None:
        return seen_end(node, is_native, moment / 1000), moment
    # a supervisor sees that its rank was killed; only the engine knows for what
    starved = outcome.signal == "SIGKILL" and node.cause is Cause.OUT_OF_MEMORY
    # another attempt fails by this exception, too, unless its node is to blame
    error = outcome.error if not outcome.requested and node.cause in (None, Cause.EXIT) else None
    end = NodeEnd(
        outcome.exit_code,
        node.words if starved else outcome.reason,
        outcome.error.time if outcome.error else outcome.ended,
        outcome.error.message if outcome.error else None,
        requested=outcome.requested,
        cannot_start=outcome.cannot_start,
        fault=str(error.fault) if error and error.fault else None,
    )
    return end, min(moment, int(outcome.ended * 1000))


def seen_end(node: NodeStatus, is_native: bool, moment: float) -> NodeEnd:
    """The end of a node that left no outcome: its supervisor's exit code, which is the job's, is the second witness.

    Args:
        node: Its status by its engine; it has ended.
        is_native: Its job came from YAML. A job of the Batch API that is preempted has lost its host: AWS has no other word for it.
        moment: When it was seen (Unix time [s]).
    """
    code = _KILLED if node.exit_code is None else node.exit_code
    if node.cause is Cause.PREEMPTED and not is_native:
        code = _KILLED
    if node.cause is Cause.EXIT:
        why = node.words.partition("; trying again")[0]
        words = f"exit {code}, outcome not written{f' ({why})' if why else ''}"
        return NodeEnd(code, words, moment, requested=None)
    words = node.words or "the supervisor died without an outcome"
    return NodeEnd(code, words, moment, lost=node.cause in _TAKEN, cannot_start=node.cause is Cause.CANNOT_START)
