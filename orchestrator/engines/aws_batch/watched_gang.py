"""A gang at AWS: the statuses of its nodes, by what AWS says of them, and the outcomes that are written in their place."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Mapping
from typing import Any

from orchestrator.domain.gang import LOG_GROUP
from orchestrator.domain.job import AWS_NOT_STARTED, TERMINAL
from orchestrator.engines.api import Cause, GangStatus, Handle, NodePhase, NodeStatus, StatusOrError
from orchestrator.engines.aws_batch.logs import CopiedLog, GangLogs
from orchestrator.engines.toolkit.outcomes import record, recorded, seen
from orchestrator.engines.toolkit.statuses import ended, one_by_one
from shared_store.contract.error_text import counted
from shared_store.volume.node_outcomes import EX_TEMPFAIL, Outcome

STRAGGLE = 180.0
"""Seconds after a job's end within which AWS says of every node that it ended, too."""
_BLAME = 60.0
"""Seconds that a failed main node waits for its children's ends: AWS ends them now, and one may have been the cause."""
_FIXED = 6.0
"""Seconds that an outcome on a shared volume may take to be seen."""


class WatchedGang:
    """The known state of one gang between two requests."""

    def __init__(self, handle: Handle, logs: GangLogs) -> None:
        """``logs``: the copies of its logs."""
        self.handle, self.logs = handle, logs
        job = handle.facts["aws"]
        self.ids = [job, *(f"{job}#{index}" for index in range(handle.nodes))]
        """AWS's ids of the job and of each of its nodes."""
        self.next = 0.0
        """When AWS is asked again (monotonic [s])."""
        self.observed: StatusOrError = ()
        """The last status, empty before the first; or the error in its place."""
        self.trouble = ""
        """Why AWS could not be asked the last time."""
        self.stopped = False
        """It was stopped: nothing of it runs, and nothing copies its logs."""
        self._over_since: float | None = None
        """When AWS first reported that the job is over (monotonic [s])."""
        self._ended: dict[int, float] = {}
        """By node: when it was first seen to have ended (monotonic [s])."""

    @property
    def is_due(self) -> bool:
        """Whether AWS is to be asked now: a gang of which nothing runs does not change any more."""
        if isinstance(self.observed, BaseException) or not self.observed:
            return True
        return time.monotonic() >= self.next and any(node.running for node in self.observed)

    def update(self, described: Mapping[str, Mapping[str, Any]], trouble: str, pause: float) -> None:
        """Take what AWS has described, by id.

        Args:
            described: Jobs and nodes.
            trouble: Why it did not answer: the last status stays, and says that it is an old one.
            pause: Seconds until it is asked again.
        """
        self.trouble, self.next = trouble, time.monotonic() + pause
        if trouble:
            unknown = [NodeStatus(NodePhase.UNREACHABLE, words=trouble)] * self.handle.nodes
            known = unknown if isinstance(self.observed, BaseException) else self.observed or unknown
            self.observed = [dataclasses.replace(node, stale=trouble) if node.running else node for node in known]
        else:
            [self.observed] = one_by_one(lambda _: self._status(described), [self.handle])

    def _status(self, described: Mapping[str, Mapping[str, Any]]) -> GangStatus:
        job, *nodes = [described.get(name) for name in self.ids]
        main = self.handle.facts["main"]
        if job is None:
            gone = NodeStatus(NodePhase.ENDED, words=f"AWS Batch has no job {self.ids[0]} any more")
            return [gone] * self.handle.nodes
        if job["status"] in TERMINAL and self._over_since is None:
            self._over_since = time.monotonic()
        main_stopped = (nodes[main] or {}).get("stoppedAt") or 0
        status = [self._node(index, node or job, job, main_stopped) for index, node in enumerate(nodes)]
        failed = not status[main].running and status[main].exit_code not in (0, EX_TEMPFAIL)
        if failed and any(node.running for node in status) and time.monotonic() - self._ended[main] < _BLAME:
            status[main] = NodeStatus(NodePhase.RUNNING, status[main].address)
        return status

    def _node(self, index: int, detail: Mapping[str, Any], job: Mapping[str, Any], main_stopped: int) -> NodeStatus:
        """``main_stopped``: when the main node stopped (Unix time [ms]; 0: it has not): AWS ends the others then."""
        status, container = detail["status"], detail.get("container") or {}
        address = next((each.get("privateIpv4Address", "") for each in container.get("networkInterfaces") or []), "")
        is_over = status in TERMINAL or (
            self._over_since is not None and time.monotonic() - self._over_since > STRAGGLE
        )
        options = (container.get("logConfiguration") or {}).get("options") or {}
        group, stream = options.get("awslogs-group", LOG_GROUP), container.get("logStreamName")
        log = self.logs.note(index, group, stream, is_over)
        if not is_over:
            if status == "RUNNING":
                return NodeStatus(NodePhase.RUNNING, address)
            phase = NodePhase.STARTING if status == "STARTING" else NodePhase.QUEUED
            return NodeStatus(phase, address, self._waiting(index, status, detail, job))
        self._ended.setdefault(index, time.monotonic())
        code = container.get("exitCode")
        code = 0 if code is None and status == "SUCCEEDED" else code
        reason = str(container.get("reason") or ("" if code == 0 else detail.get("statusReason") or ""))
        if code is not None:
            stopped = float(detail.get("stoppedAt") or time.time() * 1000)
            outcome = seen(
                self.handle, index, code, reason, stopped / 1000, 0 < main_stopped < (detail.get("stoppedAt") or 0)
            )
            if not self._settled(log, outcome):
                return NodeStatus(NodePhase.RUNNING, address)  # it has ended, but how is still on its way
        return node_ended(address, code, reason, code is None and detail.get("statusReason") == AWS_NOT_STARTED)

    def _settled(self, log: CopiedLog | None, outcome: Outcome) -> bool:
        """Whether the store has the node's outcome; it is written here if it was missing."""
        if recorded(self.handle, outcome.node) is not None:
            return True
        if not (log.whole if log is not None else time.monotonic() - self._ended[outcome.node] > _FIXED):
            return False
        record(self.handle, (log.outcome if log else None) or outcome)
        return True

    def _waiting(self, index: int, status: str, detail: Mapping[str, Any], job: Mapping[str, Any]) -> str:
        """Why a node has not been started, in words a person can act on."""
        if status == "STARTING":
            return f"AWS Batch starts node {index}: its instance pulls the image"
        if reason := detail.get("statusReason") or job.get("statusReason"):
            return f"AWS Batch: {reason}"
        if job["status"] == "RUNNING":
            return f"AWS Batch starts node {index} now that the main node runs"
        queue = str(self.handle.facts["queue"]).rpartition("/")[2]
        return (
            f"AWS Batch gets {counted(self.handle.nodes, 'instance')} for queue {queue} ({status}); "
            "if that lasts, see `muster aws status` for limits and the account's quota of vCPUs"
        )


def node_ended(address: str, code: int | None, reason: str, not_started: bool = False) -> NodeStatus:
    """A node that has ended, by its exit code and AWS's reason: of memory and lost hosts AWS tells in words alone."""
    if not_started:
        return NodeStatus(NodePhase.ENDED, address, reason, Cause.CANNOT_START)
    if reason.startswith("OutOfMemoryError"):
        return NodeStatus(NodePhase.ENDED, address, reason, Cause.OUT_OF_MEMORY, code)
    if code is None and reason and not reason.startswith("Host EC2"):
        return NodeStatus(NodePhase.ENDED, address, reason)  # AWS does not say
    return ended(address, code, reason)
