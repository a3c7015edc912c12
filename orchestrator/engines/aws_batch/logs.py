"""The output of nodes on AWS, copied from CloudWatch Logs into the run's logs, and their outcomes, which come the same way.

For a controller whose store is not the volume of the nodes, and for images without Muster. One thread a gang.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from orchestrator.engines.aws_batch.errors import FAILURES
from orchestrator.engines.toolkit.log_copy import LogCopy
from shared_store.volume.files import DamagedFile, json_object
from shared_store.volume.logs import OUTCOME_LINE, format_line, parse_line
from shared_store.volume.node_outcomes import Outcome, parse_outcome

_PACE = 0.05
"""Seconds between two requests: CloudWatch answers 25 a second for the whole account."""
_PAGE = 10_000
_LAST_WAIT = 20.0
"""Seconds that a gang which is over waits for the rest of its logs."""


@dataclass
class CopiedLog:
    """The copy of one node's log."""

    path: Path
    limit: int
    """Bytes of the copy that are kept."""
    supervised: bool
    group: str = ""
    """Name of its log group."""
    stream: str | None = None
    """Name of the stream; None until the node has one."""
    token: str | None = None
    ended: float | None = None
    """When the node was first seen to have ended (monotonic [s])."""
    received_at: float = 0.0
    """When a line last came (monotonic [s])."""
    outcome: Outcome | None = None
    whole: bool = False
    """Nothing more will come."""
    copy: LogCopy | None = None

    def take(self, events: Sequence[Mapping[str, Any]]) -> None:
        """Append events; the outcome is the last line of a supervised node. Raises OSError where the volume has no room."""
        lines = []
        for event in events:
            if self.outcome is not None:
                break
            self.received_at = time.monotonic()
            message = str(event["message"])
            line = parse_line(message, 0, 0) if self.supervised else None
            if line is None:
                rank = None if self.supervised else 0
                lines.append(format_line(float(event["timestamp"]) / 1000, rank, "o", message))
            elif line.rank is None and line.text.startswith(OUTCOME_LINE):
                with suppress(ValueError, TypeError):  # it is damaged
                    self.outcome = parse_outcome(json_object(line.text.removeprefix(OUTCOME_LINE), "outcome"))
            else:
                lines.append(message + "\n")
        assert self.copy is not None
        self.copy.append(lines)

    def settle(self, quiet: float) -> None:
        """Note whether all is there: the outcome has come, or nothing has for ``quiet`` seconds after the end."""
        silent = self.ended is not None and time.monotonic() - max(self.ended, self.received_at) > quiet
        self.whole = (self.copy is None or self.copy.is_whole) and (self.outcome is not None or silent)


class GangLogs:
    """Copies the logs of a gang's nodes until each is whole."""

    def __init__(self, client: Any, nodes: Mapping[int, CopiedLog], poll: float, quiet: float, name: str) -> None:
        """Args:
        client: Of CloudWatch Logs.
        nodes: By index, those whose logs are copied: the supervisors of the others write to the store that is here, too.
        poll: Seconds between two rounds.
        quiet: Seconds without a line after which an ended node's log is whole.
        name: Of the gang.
        """
        self.nodes, self._client, self._poll, self._quiet = nodes, client, poll, quiet
        self._wake, self._closed = threading.Event(), False
        self._thread = threading.Thread(target=self._follow, name=f"log {name}", daemon=True)
        self._thread.start()

    def note(self, index: int, group: str, stream: str | None, ended: bool) -> CopiedLog | None:
        """AWS's facts about a node: its log group, the name of its stream, whether it has ended. None where its log is not copied."""
        node = self.nodes.get(index)
        if node is not None:
            if stream:
                node.group, node.stream = group, stream
            if ended and node.ended is None:
                node.ended = time.monotonic()
                self._wake.set()
        return node

    def finish(self) -> None:
        """All nodes have ended: wait until their logs are whole, for a while, and copy no more.

        When it returns nothing here writes the logs any more.
        """
        deadline = time.monotonic() + _LAST_WAIT
        nodes = self.nodes.values()
        while not all(node.whole or node.stream is None for node in nodes) and time.monotonic() < deadline:
            self._wake.set()
            time.sleep(0.1)
        self._closed = True
        self._wake.set()
        self._thread.join()

    def _follow(self) -> None:
        while not self._closed and (nodes := [node for node in self.nodes.values() if not node.whole]):
            for node in nodes:
                # not there yet, throttled, away, the disk is full, or a link is in the log's place: the next round
                with suppress(*FAILURES, OSError, DamagedFile):
                    self._copy(node)
                node.settle(self._quiet)
            self._wake.wait(self._poll)
            self._wake.clear()
        for node in self.nodes.values():
            if node.copy is not None:
                node.copy.close()

    def _copy(self, node: CopiedLog) -> None:
        """All that has come since the last round."""
        if node.stream is None:
            return
        node.copy = node.copy or LogCopy(node.path, node.limit)
        node.copy.flush()
        while not self._closed:
            request = {"logGroupName": node.group, "logStreamName": node.stream, "startFromHead": True, "limit": _PAGE}
            page = self._client.get_log_events(**request, **({"nextToken": node.token} if node.token else {}))
            before, node.token = node.token, page["nextForwardToken"]
            node.take(page["events"])
            if before == node.token:  # AWS's sign for: that is all for now
                break
            time.sleep(_PACE)
