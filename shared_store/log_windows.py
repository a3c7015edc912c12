"""Windows of a job's log, read from anywhere and never whole: the lines before and after a place, and those that have a text.

A place in the log of a job is the position in each of its nodes' logs, by ``attempt/node``, as :class:`.logs.LogFollower` has them.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from operator import itemgetter

from shared_store.files import open_regular
from shared_store.layout import Run
from shared_store.log_files import Segment, left_out, log_segments, read_log
from shared_store.logs import HEAD, LIMIT_REACHED, LINES, LogFollower, LogLine, attempts_with_logs

Places = dict[str, int]

LINES_A_WINDOW = 400
_PIECE = 32 << 10
"""Bytes that are read of a log at once, backwards."""
_WHOLE = 512 << 10
"""More than the longest line."""
_ROUNDS = 16
"""Pieces of each log that are read for a window: few of its lines may be of the rank that is wanted."""
_FORWARD = 64 << 10
"""Bytes that are read of each log at once, forwards: a window takes few of them."""
_CHUNK = 1 << 20
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


@dataclass(frozen=True)
class Chosen:
    """Which lines of a job's log."""

    run: Run
    job: str
    node: int | None = None
    rank: int | None = None
    attempt: int | None = None

    def logs(self) -> dict[tuple[int, int], list[Segment]]:
        """The files of each log, by attempt and node, in this order. Raises OSError."""
        found = {}
        for attempt in attempts_with_logs(self.run, self.job):
            if self.attempt in (None, attempt):
                for name, segments in log_segments(self.run.logs(self.job, attempt)).items():
                    match = HEAD.fullmatch(name)
                    if match and self.node in (None, int(match[1])):
                        found[attempt, int(match[1])] = segments
        return dict(sorted(found.items()))

    def end(self) -> Places:
        """The place after the last whole line. Raises OSError."""
        return {f"{attempt}/{node}": _end(segments) for (attempt, node), segments in self.logs().items()}


@dataclass
class _Back:
    """One log that is read backwards."""

    attempt: int
    node: int
    segments: Sequence[Segment]
    place: int
    lines: list[tuple[int, LogLine]] = field(default_factory=list)
    """Those that are wanted, with the positions before them."""
    oldest: str = ""
    """Time of the first line that was read, wanted or not."""

    def read(self, rank: int | None) -> None:
        """Read the piece before ``place``."""
        start, data = _piece_before(self.segments, self.place, _PIECE)
        if b"\n" not in data[:-1] and self.place - start >= _PIECE:
            start, data = _piece_before(self.segments, self.place, _WHOLE)
        cut = 0 if any(start == each.start for each in self.segments) else data.find(b"\n") + 1
        if cut == len(data):
            cut = 0  # a line that is none of Muster's: it is left out
        found, oldest = [], ""
        for match in LINES.finditer(data, cut):
            written, number, stream, text = match.groups()
            stamp = written.decode(errors="replace")
            oldest = oldest or stamp
            place = None if number == b"-" else int(number)
            if rank is None or place == rank:
                origin = (stamp, self.attempt, self.node, place, stream.decode())
                line = LogLine(*origin, text.decode(errors="replace"), start + match.end())
                found.append((start + match.start(), line))
        self.oldest = oldest or self.oldest
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
    follower = LogFollower(chosen.run, chosen.job, chosen.node, chosen.rank, chosen.attempt, dict(place), _FORWARD)
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
class Found:
    """The lines that a search has found, and the place where it continues."""

    lines: list[LogLine]
    place: Places
    is_over: bool


def search(chosen: Chosen, text: str, place: Mapping[str, int], most: int = 100) -> Found:
    """Lines that have ``text``, whatever its case (of ASCII), log by log from ``place`` on; reads up to 32 MiB. Raises OSError."""
    needle = text.lower()
    return _search(chosen, (text.encode().lower(),), lambda line: needle in line.lower(), place, most)


def first_error(chosen: Chosen, place: Mapping[str, int]) -> Found:
    """The first line of each log that tells of an error: a traceback, an exception, ``ERROR``; reads up to 32 MiB. Raises OSError."""
    return _search(chosen, _OF_ERRORS, lambda line: _ERROR.search(line) is not None, place, 1, each=True)


def _search(
    chosen: Chosen,
    needles: Sequence[bytes],
    accepts: Callable[[str], bool],
    place: Mapping[str, int],
    most: int,
    each: bool = False,
) -> Found:
    """``each``: whether ``most`` lines of each log are wanted, and not of all together."""
    found: list[LogLine] = []
    reached, left = dict(place), _SEARCHED
    for (attempt, node), segments in chosen.logs().items():
        key, inside, here = f"{attempt}/{node}", False, 0
        while True:
            chunk = read_log(segments, reached.get(key, 0), _CHUNK, inside=inside)
            if not chunk.data:
                break
            whole = chunk.data.rfind(b"\n") + 1
            inside = not whole
            if not whole and len(chunk.data) < _CHUNK:
                break  # half a line, which is being written
            data = chunk.data[: whole or len(chunk.data)]
            hits = _hits(data, needles, accepts, chosen.rank, (most - here if each else most - len(found)))
            found += [LogLine(line.time, attempt, node, *line[3:6], chunk.start + line.position) for line in hits]
            here += len(hits)
            is_enough = (here if each else len(found)) >= most
            reached[key] = chunk.start + (hits[-1].position if is_enough else len(data))
            left -= len(data)
            if is_enough and not each:
                return Found(found, reached, False)
            if is_enough:
                reached[key] = _end(segments)
                break
            if left <= 0:
                return Found(found, reached, False)
    return Found(found, reached, True)


def _hits(
    data: bytes, needles: Sequence[bytes], accepts: Callable[[str], bool], rank: int | None, most: int
) -> list[LogLine]:
    """The first ``most`` lines with one of the needles; their positions are those in ``data``."""
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
        match = LINES.match(data, begin, end)
        if match:
            written, number, stream, text = (each.decode(errors="replace") for each in match.groups())
            place = None if number == "-" else int(number)
            if rank in (None, place) and accepts(text):
                hits.append(LogLine(written, 0, 0, place, stream, text, end))
        for needle, at in nexts.items():
            if 0 <= at < end:
                nexts[needle] = folded.find(needle, end)
    return hits


def _end(segments: Sequence[Segment]) -> int:
    """The position after the last whole line of a log."""
    start, _, path = segments[-1]
    size = start + path.stat().st_size
    for most in (4 << 10, _WHOLE):
        begin, data = _piece_before(segments, size, most)
        if at := data.rfind(b"\n") + 1:
            return begin + at
    return start


def _piece_before(segments: Sequence[Segment], place: int, most: int) -> tuple[int, bytes]:
    """Up to ``most`` bytes of one file that end at ``place``, and the position of the first one."""
    start, _, path = next((each for each in reversed(segments) if each.start < place), segments[0])
    begin = max(start, place - most)
    with open_regular(path) as file:
        file.seek(max(0, begin - start))
        return begin, file.read(max(0, place - begin))
