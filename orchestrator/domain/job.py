"""A job and its attempts: the states of AWS Batch, their legal transitions, and the verdict on a gang's end. No I/O."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum

from orchestrator.domain.excerpts import LONGEST_REASON, excerpt
from shared_store.volume.node_outcomes import EX_TEMPFAIL, first_cause

WAITING = "waiting for the scheduler"
"""Reason of a RUNNABLE job that no scheduling pass has considered yet."""


class Status(StrEnum):
    """State of a job (AWS Batch user guide, "Job states")."""

    SUBMITTED = "SUBMITTED"
    PENDING = "PENDING"
    RUNNABLE = "RUNNABLE"
    STARTING = "STARTING"
    RUNNING = "RUNNING"
    SUCCEEDED = "SUCCEEDED"
    FAILED = "FAILED"

    @property
    def is_terminal(self) -> bool:
        return self in TERMINAL


TERMINAL = (Status.SUCCEEDED, Status.FAILED)
"""States of a job that has ended."""

EARLY = (Status.SUBMITTED, Status.PENDING, Status.RUNNABLE)
"""States of a job that has not started to start: CancelJob ends no other."""

TRANSITIONS = {
    Status.SUBMITTED: {Status.PENDING, Status.RUNNABLE, Status.FAILED},
    Status.PENDING: {Status.RUNNABLE, Status.SUCCEEDED, Status.FAILED},
    Status.RUNNABLE: {Status.STARTING, Status.FAILED},
    Status.STARTING: {Status.RUNNING, Status.RUNNABLE, Status.SUCCEEDED, Status.FAILED},
    Status.RUNNING: {Status.RUNNABLE, Status.SUCCEEDED, Status.FAILED},
    Status.SUCCEEDED: set[Status](),
    Status.FAILED: set[Status](),
}
"""A failed attempt with tries left goes back to RUNNABLE, as on AWS; an array is PENDING until its children have ended."""


def check_transition(before: Status, after: Status) -> None:
    """Raises ValueError for a transition that AWS Batch does not have."""
    if after != before and after not in TRANSITIONS[before]:
        raise ValueError(f"a job can't go from {before} to {after}")


class Ending(StrEnum):
    """Why an attempt is over."""

    SUCCEEDED = "succeeded"
    FAILED = "failed"
    """A failure that a retry may mend."""
    LOST = "lost"
    """The same, for a node that is silent: the others may save."""
    FATAL = "fatal"
    """A failure after which the job is not tried again."""
    PREEMPTED = "preempted"
    """Stopped in favour of another job: started again without spending an attempt, unless it was done (exit 0)."""
    REQUEUE = "requeue"
    """Checkpointed and left on request (exit 75): started again without spending an attempt."""
    CANCELLED = "cancelled"
    """The same as REQUEUE, since others than Muster cancelled the gang in its engine's own queue."""
    STOPPED = "stopped"
    """Requested by a user or through the API."""
    TIMEOUT = "timeout"


@dataclass(frozen=True)
class RunTime:
    """How long a job has run, all its attempts together, without the waits between them."""

    seconds: float
    since: int | None
    """While an attempt runs: when the job would have started, had it run without a pause (Unix time [ms])."""

    @classmethod
    def of(cls, attempts: Iterable[tuple[int | None, int | None]], moment: int) -> RunTime | None:
        """None for a job that has not started.

        Args:
            attempts: Start and end of each (Unix time [ms]); no end: it runs.
            moment: The present (Unix time [ms]).
        """
        started = [(start, end) for start, end in attempts if start is not None]
        if not started:
            return None
        passed = sum(max(0, (moment if end is None else end) - start) for start, end in started)
        runs = any(end is None for _, end in started)
        return cls(passed / 1000, moment - passed if runs else None)


@dataclass(frozen=True)
class NodeEnd:
    """The end of one node; ``ended`` is the Unix time [s] of its first error, or of its end."""

    exit_code: int
    reason: str
    ended: float
    error: str | None = None
    """Message of the node's first error."""
    lost: bool = False
    """The end was not observed: the node vanished, presumably with its host."""
    requested: bool | None = False
    """The node was asked to end: the cause lies elsewhere. None: that is not known."""
    cannot_start: bool = False
    """Its program or its container could not be started."""
    fault: str | None = None
    """Type, file, line and cause of the Python exception that ended it, if another attempt would meet that, too."""

    def __post_init__(self) -> None:
        object.__setattr__(
            self, "reason", excerpt(self.reason, LONGEST_REASON)
        )  # engines pass on text of other programs


@dataclass(frozen=True)
class Verdict:
    """The attempt's verdict, from the ends observed so far."""

    ending: Ending
    reason: str
    exit_code: int | None = None
    certain: bool = True
    """False while every node that has ended was asked to end: the cause may be observed later."""
    fault: str | None = None
    """As :attr:`NodeEnd.fault`, of the node that was the cause; native jobs only."""
    start_error: str | None = None
    """Why the gang was never started, if so: the reason of the main node."""


_LOST_HOST = "Host EC2"
AWS_EXITED = "Essential container in task exited"
"""AWS Batch's reason for an attempt whose main container ended, successfully or not; clients match it."""
AWS_NOT_STARTED = "Task failed to start"
"""The same for one whose main container could not be started."""
AWS_CHILD_FAILED = "Array Child Job failed"
"""AWS Batch's reason for an array with failed children."""


_OF_AWS = re.compile(r"[A-Z][A-Za-z]*Error: ")
"""Beginning of a reason for which AWS ended a container, or could not start it: OutOfMemoryError, CannotPullContainerError, …"""


def container_reason(reason: str | None, status_reason: str | None) -> str | None:
    """``container.reason`` as AWS gives it: an ordinary exit has none.

    Args:
        reason: The node's own, in Muster's words.
        status_reason: The attempt's on this node.
    """
    if status_reason and status_reason.startswith(_LOST_HOST):
        return status_reason
    if reason and _OF_AWS.match(reason):
        return reason
    return f"CannotStartContainerError: {reason}" if reason and status_reason == AWS_NOT_STARTED else None


def has_exited(status_reason: str | None) -> bool:
    """Whether AWS knows the exit code of a node with this status reason: not where it was lost, or never started."""
    return status_reason != AWS_NOT_STARTED and not (status_reason or "").startswith(_LOST_HOST)


def lost_host(host: str) -> str:
    """AWS Batch's reason for an attempt that has lost the host of its main node."""
    return f"{_LOST_HOST} (instance {host}) terminated."


def aws_ending(end: NodeEnd, host: str) -> str:
    """AWS Batch's status reason for a node that ended by itself."""
    if end.lost:
        return lost_host(host)
    return AWS_NOT_STARTED if end.cannot_start else AWS_EXITED


_LOST = re.escape(lost_host("HOST")).replace("HOST", "[^)]*")
AWS_ENDINGS = re.compile(rf"(?<![^(])(?:{AWS_EXITED}|{AWS_NOT_STARTED}|{_LOST})")
"""These three reasons, which AWS Batch gives whatever the main node's own reason is; at the start of a text, or of its parentheses."""


def judge_as_aws(main: int, ends: Sequence[NodeEnd | None], host: str) -> Verdict | None:
    """The same for a job of the Batch API: the main node's end ends the job and decides, in AWS's own words.

    Args:
        main: Index of the main node.
        ends: By node index; None for a node that runs or has not started.
        host: Name of the main node's host.
    """
    head = ends[main]
    if head is None:
        return None
    reason = aws_ending(head, host)
    if not has_exited(reason):
        return Verdict(Ending.FAILED, reason, None)
    return Verdict(Ending.SUCCEEDED if head.exit_code == 0 else Ending.FAILED, reason, head.exit_code)


def judge(policy: str, main: int, ends: Sequence[NodeEnd | None]) -> Verdict | None:
    """Whether the attempt is over, from how its nodes ended; None while it continues.

    The main node's end ends the job and decides (AWS Batch). The meaning of a child's failure is ``policy``: ``ignore`` nothing
    (what AWS does), ``restart`` a new attempt, ``fail`` the end of the job.

    Args:
        policy: ``restart``, ``fail`` or ``ignore``.
        main: Index of the main node.
        ends: By node index; None for a node that runs or has not started.
    """
    failures = [(index, end) for index, end in enumerate(ends) if end and end.exit_code not in (0, EX_TEMPFAIL)]
    head, is_unseen = ends[main], None in ends
    if head is not None and head.exit_code == 0:
        return Verdict(Ending.SUCCEEDED, AWS_EXITED, 0)
    if head is not None and head.exit_code == EX_TEMPFAIL:
        return Verdict(Ending.REQUEUE, head.reason, EX_TEMPFAIL)
    if policy == "ignore":
        if head is None:
            return None
        return Verdict(Ending.FAILED, f"main node: {head.reason}", head.exit_code, fault=head.fault)
    if not failures:
        return None
    # A child that dies breaks the main node's collectives within a second, so the first failure by time is the cause.
    index, first = failures[first_cause([(bool(end.requested), end.ended) for _, end in failures])]
    ending = Ending.FATAL if policy == "fail" and index != main else Ending.FAILED
    reason = f"{'main node' if index == main else f'node {index}'}: {first.reason}"
    return Verdict(ending, reason, first.exit_code, certain=not (first.requested and is_unseen), fault=first.fault)


def retries(conditions: Sequence[Mapping[str, str]], exit_code: int | None, reason: str, status_reason: str) -> bool:
    """``retryStrategy.evaluateOnExit``: whether the first matching condition says RETRY; True if none matches, as on AWS.

    Args:
        conditions: ``evaluateOnExit``; what one entry names must all match.
        exit_code: Of the main node's container; None where it has none.
        reason: Of the main node's container.
        status_reason: Of the attempt.
    """
    seen = {
        "onExitCode": "" if exit_code is None else str(exit_code),
        "onReason": reason,
        "onStatusReason": status_reason,
    }
    for condition in conditions:
        if all(_matches(condition[key], text) for key, text in seen.items() if condition.get(key)):
            return condition["action"].upper() == "RETRY"
    return True


def _matches(pattern: str, text: str) -> bool:
    """A pattern may end in ``*``."""
    return text.startswith(pattern[:-1]) if pattern.endswith("*") else text == pattern
