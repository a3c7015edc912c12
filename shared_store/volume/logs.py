"""Logs: one log per node and attempt, one writer per log, lines ``<RFC 3339 UTC, µs> <rank or -> <o|e> <text>``."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from datetime import UTC, datetime
from json.encoder import encode_basestring_ascii
from typing import NamedTuple

_LINE = re.compile(r"(\S+) (-|\d{1,9}) ([oe]) (.*)", re.DOTALL)
STAMP = rb"(?:19[7-9]\d|2[01]\d\d)-(?:0[1-9]|1[0-2])-(?:0[1-9]|[12]\d|3[01])T(?:[01]\d|2[0-3]):[0-5]\d:[0-5]\d\.\d{6}Z"
"""Time of a line."""
_LINES = re.compile(rb"^(" + STAMP + rb") (-|\d{1,9}) ([oe]) (.*)\n", re.MULTILINE)
"""Whole lines of a file: time, rank, stream, text."""

LIMIT_REACHED = "the log reached its limit"
REPLACED = "the log was truncated or replaced; following continues from its new beginning"

END_LINE = "node {node} ended: {reason}"
"""The supervisor's last line: no output of the job, so CloudWatch Logs does not show it."""
OUTCOME_LINE = "muster-outcome "
"""Beginning of a supervisor's last line where its log leaves the node as text (AWS); the outcome follows as JSON."""


class LogLine(NamedTuple):
    """One line of a node's log."""

    time: str
    """RFC 3339, UTC, microseconds: ``2026-01-31T12:00:00.000000Z``; sorts as text."""
    attempt: int
    node: int
    rank: int | None
    """Global rank; None for the supervisor's own lines."""
    stream: str
    """``o`` standard output, ``e`` standard error."""
    text: str
    position: int = 0
    """Position in the log after this line (:mod:`.log_files`)."""

    def to_json(self) -> str:
        """One line of JSON, without its newline; printable ASCII only."""
        rank = "null" if self.rank is None else self.rank
        return (
            f'{{"time": {encode_basestring_ascii(self.time)}, "attempt": {self.attempt}, "node": {self.node}, "rank": {rank}, '
            f'"stream": "{self.stream}", "text": {encode_basestring_ascii(self.text)}, "position": {self.position}}}'
        )


def timestamp(seconds: float) -> str:
    """Unix time [s] as RFC 3339 UTC with microseconds."""
    return datetime.fromtimestamp(seconds, UTC).strftime("%Y-%m-%dT%H:%M:%S.%fZ")


def format_line(seconds: float, rank: int | None, stream: str, text: str) -> str:
    """One line of the file, with its newline; a newline inside ``text`` is kept as ``\\n``'s two characters."""
    return format_lines(seconds, rank, stream, [text])


def format_lines(seconds: float, rank: int | None, stream: str, texts: Iterable[str]) -> str:
    """:func:`format_line` for many lines of the same time and origin."""
    before = f"{timestamp(seconds)} {'-' if rank is None else rank} {stream} "
    return "".join([f"{before}{_escaped(text)}\n" for text in texts])


def _escaped(text: str) -> str:
    return text.replace("\r", "").replace("\n", "\\n") if "\n" in text or "\r" in text else text


def parse_line(line: str, attempt: int, node: int) -> LogLine | None:
    """The line as written by :func:`format_line`; None for any other text."""
    match = _LINE.fullmatch(line)
    if not match:
        return None
    rank = None if match[2] == "-" else int(match[2])
    return LogLine(match[1], attempt, node, rank, match[3], match[4])


def lines_in(
    data: bytes, log: tuple[int, int], start: int, begin: int = 0, end: int | None = None
) -> Iterator[tuple[int, LogLine]]:
    """The whole lines of a part of a log, each with the position at which it begins; other text is left out.

    Args:
        data: The part.
        log: Attempt and node.
        start: Position of the first byte of ``data``.
        begin: Byte of ``data`` at which the first line begins.
        end: Byte of ``data`` at which the last one ends; None: its end.
    """
    attempt, node = log
    for match in _LINES.finditer(data, begin, len(data) if end is None else end):
        stamp, number, stream, text = match.groups()
        rank, words = None if number == b"-" else int(number), text.decode("utf-8", "replace")
        line = LogLine(stamp.decode(), attempt, node, rank, stream.decode(), words, start + match.end())
        yield start + match.start(), line
