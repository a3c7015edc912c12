"""Windows of a job's log, read from anywhere and never whole: the lines before and after a place, and those that have a text."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from operator import itemgetter

from shared_store.volume.log_files import LogSegment, left_out, read_log
from shared_store.volume.log_view import CHUNK, WHOLE, Chosen, Key, LogView, Places, log_end, piece_before
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


@dataclass
class _Back:
    """One log that is read backwards."""

    attempt: int
    node: int
    segments: Sequence[LogSegment]
    place: int
    lines: list[tuple[int, LogLine]] = field(default_factory=list)
    """Those that are chosen, with the positions before them."""
    oldest: str = ""
    """Time of the first line that was read, chosen or not."""

    def read(self, rank: int | None) -> None:
        """Read the piece before ``place``."""
        start, data = piece_before(self.segments, self.place, _PIECE)
        if b"\n" not in data[:-1] and self.place - start >= _PIECE:
            start, data = piece_before(self.segments, self.place, WHOLE)
        cut = 0 if any(start == each.start for each in self.segments) else data.find(b"\n") + 1
        if cut == len(data):
            cut = 0  # a line that is none of Muster's: it is left out
        every = list(lines_in(data, (self.attempt, self.node), start, cut))
        self.oldest = every[0][1].time if every else self.oldest
        found = [each for each in every if rank is None or each[1].rank == rank]
        missing = self._gap(start + cut)
        if missing:
            text = left_out(None, missing, LIMIT_REACHED)
            found.insert(0, (start + cut, LogLine(self.oldest, self.attempt, self.node, None, "e", text, start + cut)))
        self.lines = found + self.lines
        self.place = start + cut - missing

    def _gap(self, place: int) -> int:
        """Bytes before ``place`` that were deleted when the log reached its limit."""
        for before, after in zip(self.segments, self.segments[1:], strict=False):
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
        sources = [
            _Back(attempt, node, segments, place.get(f"{attempt}/{node}", 0))
            for (of, node), segments in logs.items()
            if of == attempt and place.get(f"{attempt}/{node}", 0) > 0
        ]
        lines = _merged_before(sources, chosen.rank, most - len(found), first)
        found = lines + found
        if any(first.get(f"{attempt}/{source.node}", 0) for source in sources) or len(found) >= most:
            break
    return Window(found, first, dict(place), any(first.get(f"{attempt}/{node}", 0) for attempt, node in logs))


def _merged_before(sources: Sequence[_Back], rank: int | None, most: int, first: Places) -> list[LogLine]:
    """The last ``most`` lines of several logs by their times; notes in ``first`` where they begin."""
    bound = ""
    for _ in range(_ROUNDS):
        # what is older than the first line read of a log that goes on may be older than a line of it that was not read yet
        bound = max((source.oldest for source in sources if source.place), default="")
        ready = sum(line.time >= bound for source in sources for _, line in source.lines)
        reading = [source for source in sources if source.place and source.oldest >= bound]
        if ready >= most or not reading:
            break
        for source in reading:
            source.read(rank)
    bound = max((source.oldest for source in sources if source.place), default="")
    kept: list[tuple[str, int, int, LogLine]] = []
    for number, source in enumerate(sources):
        newest = ""
        for index, (_, line) in enumerate(source.lines):
            newest = max(newest, line.time)  # a clock that was set back does not reorder the lines of a node
            if newest >= bound:
                kept.append((newest, number, index, line))
    kept = sorted(kept, key=itemgetter(0, 1, 2))[-most:] if most > 0 else []
    begins: dict[int, int] = {}
    for _, number, index, _ in kept:
        begins[number] = min(index, begins.get(number, index))
    for number, source in enumerate(sources):
        begin = begins.get(number, len(source.lines))
        if begin == 0:  # all that was read is returned, also what is of other ranks
            place = source.place
        else:
            place = source.lines[begin][0] if begin < len(source.lines) else source.lines[-1][1].position
        first[f"{source.attempt}/{source.node}"] = place
    return [line for *_, line in kept]


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
    taken = {f"{line.attempt}/{line.node}": line.position for line in lines[:most]}
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
    for (attempt, node), segments in chosen.logs().items():
        key, inside, here = f"{attempt}/{node}", False, 0
        while True:
            chunk = read_log(segments, reached.get(key, 0), CHUNK, inside=inside)
            if not chunk.data:
                break
            whole = chunk.data.rfind(b"\n") + 1
            inside = not whole
            if not whole and len(chunk.data) < CHUNK:
                break  # half a line, which is being written
            data = chunk.data[: whole or len(chunk.data)]
            left_over = most - here if each else most - len(found)
            hits = _hits(data, (attempt, node), chunk.start, needles, accepts, chosen.rank, left_over)
            found += hits
            here += len(hits)
            is_enough = (here if each else len(found)) >= most
            reached[key] = hits[-1].position if is_enough else chunk.start + len(data)
            left -= len(data)
            if is_enough and not each:
                return FoundLines(found, reached, False)
            if is_enough:
                reached[key] = log_end(segments)
                break
            if left <= 0:
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
        there = min((at for at in nexts.values() if at >= 0), default=-1)
        if there < 0:
            break
        begin, end = data.rfind(b"\n", 0, there) + 1, data.find(b"\n", there) + 1
        if end == 0:
            break
        for _, line in lines_in(data, log, start, begin, end):
            if rank in (None, line.rank) and accepts(line.text):
                hits.append(line)
        for needle, at in nexts.items():
            if 0 <= at < end:
                nexts[needle] = folded.find(needle, end)
    return hits
