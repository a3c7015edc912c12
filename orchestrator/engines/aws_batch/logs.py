"""The output of nodes on AWS, copied from CloudWatch Logs into the run's logs, and their outcomes, which come the same way.

For a controller whose store is not the volume of the nodes, and for images without Muster. One thread a gang.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from botocore.exceptions import BotoCoreError, ClientError
from botocore.parsers import ResponseParserError

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
    copied: bool = True
    """False where the supervisor writes it to the store that is here, too."""
    group: str = ""
    """Name of its log group."""
    stream: str | None = None
    """Name of the stream; None until the node has one."""
    token: str | None = None
    ended: float | None = None
    """When the node was first seen to have ended (monotonic [s])."""
    heard: float = 0.0
    """When a line last came (monotonic [s])."""
    outcome: Outcome | None = None
    whole: bool = False
    """Nothing more will come."""
    _copy: LogCopy | None = None

    def open(self) -> None:
        """Go on with the copy. Raises OSError."""
        if self._copy is None:
            self._copy = LogCopy(self.path, self.limit)
        self._copy.flush()

    def close(self) -> None:
        if self._copy is not None:
            self._copy.close()
            self._copy = None

    def take(self, events: list[Mapping[str, Any]]) -> None:
        """Append what came; the outcome is the last line of a supervised node.

        Raises OSError where the volume has no room; :meth:`open` tries again.
        """
        lines = []
        for event in events:
            if self.outcome is not None:
                break
            self.heard = time.monotonic()
            line = self._line(str(event["message"]), float(event["timestamp"]) / 1000)
            if line is not None:
                lines.append(line)
        assert self._copy is not None
        self._copy.append(lines)

    def _line(self, message: str, seconds: float) -> str | None:
        """As it belongs into the run's log; None for the outcome, which is kept."""
        if not self.supervised:
            return format_line(seconds, 0, "o", message)
        said = parse_line(message, 0, 0)
        if said is None:
            return format_line(seconds, None, "o", message)
        if said.rank is None and said.text.startswith(OUTCOME_LINE):
            self.outcome = read_outcome_line(said.text)
            return None
        return message + "\n"

    def settle(self, quiet: float) -> None:
        """Whether all is there: the outcome has come, or nothing has for ``quiet`` seconds after the end."""
        silent = self.ended is not None and time.monotonic() - max(self.ended, self.heard) > quiet
        self.whole = (self._copy is None or self._copy.is_whole) and (self.outcome is not None or silent)


def read_outcome_line(text: str) -> Outcome | None:
    """The outcome that a supervisor printed; None where it is damaged."""
    try:
        return parse_outcome(json_object(text.removeprefix(OUTCOME_LINE), "outcome"))
    except (ValueError, TypeError):
        return None


@dataclass
class GangLogs:
    """Copies the logs of all nodes of a gang until each is whole."""

    client: Any
    """Of CloudWatch Logs."""
    nodes: list[CopiedLog]
    poll: float
    """Seconds between two rounds."""
    quiet: float
    """Seconds without a line after which an ended node's log is whole."""
    _wake: threading.Event = field(default_factory=threading.Event)
    _closed: bool = False
    _thread: threading.Thread | None = None

    def start(self, name: str) -> None:
        for node in self.nodes:
            node.whole = not node.copied
        self._thread = threading.Thread(target=self._follow, name=f"log {name}", daemon=True)
        self._thread.start()

    def saw(self, index: int, group: str, stream: str | None, ended: bool) -> CopiedLog:
        """AWS's facts about a node: its log group, the name of its stream, and whether it has ended."""
        node = self.nodes[index]
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
        while not all(node.whole or node.stream is None for node in self.nodes) and time.monotonic() < deadline:
            self._wake.set()
            time.sleep(0.1)
        self._closed = True
        self._wake.set()
        if self._thread is not None:
            self._thread.join()

    def _follow(self) -> None:
        while not self._closed and not all(node.whole for node in self.nodes):
            for node in self.nodes:
                if not node.whole:
                    self._copy(node)
            self._wake.wait(self.poll)
            self._wake.clear()
        for node in self.nodes:
            node.close()

    def _copy(self, node: CopiedLog) -> None:
        """All that has come since the last look."""
        try:
            if node.stream is not None:
                node.open()
            while node.stream is not None and not self._closed:
                request = {"logGroupName": node.group, "logStreamName": node.stream, "startFromHead": True}
                if node.token:
                    request["nextToken"] = node.token
                page = self.client.get_log_events(**request, limit=_PAGE)
                before, node.token = node.token, page["nextForwardToken"]
                node.take(page["events"])
                if before == node.token:  # AWS's sign for: that is all for now
                    break
                time.sleep(_PACE)
        except (ClientError, BotoCoreError, ResponseParserError, OSError, DamagedFile):
            pass  # not there yet, throttled, away, the disk is full, or a link is in the log's place: the next round
        node.settle(self.quiet)
