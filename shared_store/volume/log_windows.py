"""Windows of a job's log, read from anywhere and never whole: the lines before and after a place, and those that have a text."""

from __future__ import annotations

import heapq
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import accumulate, islice, pairwise
from operator import itemgetter

from shared_store.volume.log_files import CHUNK, LogCursor, LogSegment, left_out, log_end, piece_before
from shared_store.volume.log_view import Chosen, Key, LogView, Places, place_of
from shared_store.volume.logs import LIMIT_REACHED, LogLine, lines_in

LINES_A_WINDOW = 400
_PIECE = 32 << 10
"""Bytes that are read of a log at once, backwards."""
_ROUNDS = 16
"""Pieces of each log that are read for a window: few of its lines may be of the rank that was asked for."""
_FORWARD = 64 << 10
"""Bytes that are read of each log at once, forwards: a window takes few of them."""
_SEARCHED = 32 << 20
"""Bytes that one search reads."""

_ERROR = re.compile(
    r"Traceback \(most recent call last\)|\b[A-Za-z]*(?:Error|Exception): |\b(?:ERROR|FATAL|CRITICAL)\b|\b[Ee]rror: |[Oo]ut of memory"
    r"|can't start '|[Cc]ommand not found|: not found$|No such file or directory|Permission denied"
)
_OF_SHELLS = (b"not found", b"no such file or directory", b"permission denied")
_OF_ERRORS = (
    b"traceback (",
    b"error",
    b"exception: ",
    b"fatal",
    b"critical",
    b"out of memory",
    b"can't start '",
    *_OF_SHELLS,
)


@dataclass(frozen=True)
class Window:
    """Lines of a log in the order of their times, and the places where they begin and end."""

    lines: list[LogLine]
    first: Places
    last: Places
    more: bool
    """Whether there are earlier lines (of :func:`lines_before`) or later ones (of :func:`lines_after`)."""


class _Unread(Exception):
    """A log has more lines, which are not read for this window."""


@dataclass
class _Back:
    """One log that is read backwards."""

    log: Key
    segments: Sequence[LogSegment]
    place: int
    """Position from which on all chosen lines were returned."""

    def lines(self, rank: int | None) -> Iterator[tuple[str, int, LogLine, _Back]]:
        """The chosen lines before ``place``, the last one first: its time for merging, the position before it, the line, this log.

        Raises _Unread behind the last line that is read, OSError.
        """
        place, oldest, later = self.place, "", "~"
        for _ in range(_ROUNDS):
            if not place:
                break
            start, data = piece_before(self.segments, place, _PIECE)
            if b"\n" not in data[:-1] and place - start >= _PIECE:
                start, data = piece_before(self.segments, place, CHUNK)
            cut = 0 if any(start == each.start for each in self.segments) else data.find(b"\n") + 1
            if cut == len(data):
                cut = 0  # a line that is none of Muster's: it is left out
            every = list(lines_in(data, self.log, start, cut))
            # a clock that was set back does not reorder the lines of a node
            times = accumulate((line.time for _, line in every), max)
            for time, (begin, line) in reversed(list(zip(times, every, strict=True))):
                later = min(later, time)
                if rank in (None, line.rank):
                    yield later, begin, line, self
            oldest = every[0][1].time if every else oldest
            begin = start + cut
            place = begin - self._gap(begin)
            if place < begin:
                text = left_out(None, begin - place, LIMIT_REACHED)
                yield min(later, oldest), place, LogLine(oldest, *self.log, None, "e", text, begin), self
        self.place = place
        if place:
            raise _Unread

    def _gap(self, place: int) -> int:
        """Bytes before ``place`` that were deleted when the log reached its limit."""
        for before, after in pairwise(self.segments):
            if after.start == place:
                return max(0, place - before.start - before.path.stat().st_size)
        return 0


def lines_before(chosen: Chosen, place: Mapping[str, int], most: int = LINES_A_WINDOW) -> Window:
    """The last lines before a place, of one attempt, or of several where few of one are left.

    Reads a bounded part of each log: it may return fewer lines than there are, and then has ``more``. Raises OSError.
    """
    found: list[LogLine] = []
    first = dict(place)
    logs = chosen.logs()
    for attempt in sorted({each for each, _ in logs}, reverse=True):
        sources = [_Back(log, logs[log], place.get(place_of(log), 0)) for log in logs if log[0] == attempt]
        # of lines of the same time, those of the last node are the last
        lines = heapq.merge(*(each.lines(chosen.rank) for each in reversed(sources)), key=itemgetter(0), reverse=True)
        with suppress(_Unread):  # what is older may be older than a line that was not read
            for _, begin, line, source in islice(lines, most - len(found)):
                found.append(line)
                source.place = begin
        first |= {
            place_of(source.log): source.place
            for source in sources
            if source.place != place.get(place_of(source.log), 0)
        }
        if len(found) >= most or any(source.place for source in sources):
            break
    return Window(found[::-1], first, dict(place), any(first.get(place_of(log), 0) for log in logs))


def lines_after(chosen: Chosen, place: Mapping[str, int], most: int = LINES_A_WINDOW) -> Window:
    """The lines after a place; of a log that ``place`` does not name, from its beginning.

    Reads a bounded part of each log: it may return fewer lines than there are, and then has ``more``. Raises OSError.
    """
    follower = LogView(chosen, dict(place), _FORWARD)
    lines = follower.poll()
    for _ in range(_ROUNDS - 1):
        if len(lines) >= most or not follower.behind:
            break
        lines += follower.poll()
    if len(lines) <= most:
        return Window(lines, dict(place), dict(follower.offsets), follower.behind)
    taken = {place_of((line.attempt, line.node)): line.position for line in lines[:most]}
    return Window(lines[:most], dict(place), {**place, **taken}, True)


@dataclass(frozen=True)
class FoundLines:
    """The lines that a search has found, and the place where it continues."""

    lines: list[LogLine]
    place: Places
    is_over: bool


def search(chosen: Chosen, text: str, place: Mapping[str, int], most: int = 100) -> FoundLines:
    """Lines that have ``text``, whatever its case (of ASCII), log by log from ``place`` on; reads up to 32 MiB. Raises OSError."""
    needle = text.lower()
    return _search(chosen, (text.encode().lower(),), lambda line: needle in line.lower(), place, most)


def first_error(chosen: Chosen, place: Mapping[str, int]) -> FoundLines:
    """The first line of each log that tells of an error: a traceback, an exception, ``ERROR``; reads up to 32 MiB. Raises OSError."""
    return _search(chosen, _OF_ERRORS, lambda line: _ERROR.search(line) is not None, place, 1, each=True)


def _search(
    chosen: Chosen,
    needles: Sequence[bytes],
    accepts: Callable[[str], bool],
    place: Mapping[str, int],
    most: int,
    each: bool = False,
) -> FoundLines:
    """``each``: whether ``most`` lines of each log are wanted, and not of all together."""
    found: list[LogLine] = []
    reached, left = dict(place), _SEARCHED
    for log, segments in chosen.logs().items():
        key, before = place_of(log), len(found) if each else 0
        cursor = LogCursor(reached.get(key, 0))
        while (chunk := cursor.read(segments)).data:
            hits = _hits(chunk.data, log, chunk.start, needles, accepts, chosen.rank, most + before - len(found))
            found += hits
            left -= len(chunk.data)
            is_enough = len(found) - before >= most
            reached[key] = hits[-1].position if is_enough else cursor.position
            if is_enough and each:
                reached[key] = log_end(segments)
                break
            if is_enough or left <= 0:
                return FoundLines(found, reached, False)
    return FoundLines(found, reached, True)


def _hits(
    data: bytes,
    log: Key,
    start: int,
    needles: Sequence[bytes],
    accepts: Callable[[str], bool],
    rank: int | None,
    most: int,
) -> list[LogLine]:
    """The first ``most`` lines with one of the needles in a part of a log, which begins at ``start``."""
    folded = data.lower()
    nexts = {needle: folded.find(needle) for needle in needles}
    hits: list[LogLine] = []
    while len(hits) < most:
        at = min((at for at in nexts.values() if at >= 0), default=-1)
        if at < 0:
            break
        begin, end = data.rfind(b"\n", 0, at) + 1, data.find(b"\n", at) + 1
        if end == 0:
            break
        for _, line in lines_in(data, log, start, begin, end):
            if rank in (None, line.rank) and accepts(line.text):
                hits.append(line)
        for needle, at in nexts.items():
            if 0 <= at < end:
                nexts[needle] = folded.find(needle, end)
    return hits
