"""The metrics of a run, one JSON line per iteration, one file per epoch.

An attempt that resumes from iteration k supersedes the later records of earlier attempts, so that a run has one history: no
iteration twice, none from an abandoned past.
"""

from __future__ import annotations

import json
import math
import os
import re
import threading
from bisect import bisect_right
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from functools import lru_cache
from io import FileIO
from itertools import islice
from pathlib import Path
from typing import Any

from shared_store.volume.files import DamagedFile, json_object, open_regular
from shared_store.volume.layout import Run

_SECTIONS = {
    "reward": "episode/reward",
    "episode_length": "episode/length",
    "steps_per_second": "speed/steps_per_second",
    "collect_seconds": "speed/collect_seconds",
    "learn_seconds": "speed/learn_seconds",
    "iteration_seconds": "speed/iteration_seconds",
}
THIS_RUN = "RUN@"
"""Begins a checkpoint's reference in a record's warnings, since records do not depend on the run's name; :func:`warnings_of` puts it in."""
_NAME = re.compile(r"metrics-e([0-9]{1,18})\.jsonl")
_KEPT = 32 << 20
"""Bytes of records that wait for room on the volume; later ones are lost."""
_BLOCK = 16 << 10
"""Bytes between two marks."""
_LONGEST = 64 << 10
"""Bytes of a line; a longer one is not a record, and is skipped."""
_LOOK = 64 << 20
"""Bytes of new lines that one look at a history reads; the next look continues after them."""
_IDENTITY = 256
"""Bytes of a file's beginning that identify it."""


class MetricsWriter:
    """Appends the metrics of one attempt; one writer per file, on the main node."""

    def __init__(self, run: Run, epoch: int, resumed_from: int) -> None:
        """Begin the file of ``epoch``; ``resumed_from`` is the number of finished iterations (0 for a new run)."""
        self.path = run.metrics / f"metrics-e{epoch}.jsonl"
        self._file: FileIO | None = None
        """None until the volume has the file."""
        self._left = bytearray()
        """What the volume has not taken yet."""
        with suppress(OSError):  # it goes with the first iteration's record
            self.write({"resumed_from": resumed_from})

    def write(self, record: Mapping[str, Any]) -> None:
        """Append one record; ``iteration`` counts from 1. Non-finite values must be None.

        Raises OSError where the volume does not take it now: the record is kept, up to a limit, and goes with the next one.
        """
        if len(self._left) < _KEPT:
            self._left += json.dumps(record, allow_nan=False).encode() + b"\n"
        self._flush()

    def _flush(self) -> None:
        if self._file is None:
            self.path.parent.mkdir(exist_ok=True)  # not its parents: where the run is not, the volume is another one
            self._file = open(self.path, "ab", buffering=0)  # noqa: SIM115 - closed by close()
        while self._left:
            del self._left[: self._file.write(self._left)]

    def close(self) -> None:
        """Raises OSError where records are left that the volume does not take."""
        try:
            self._flush()
        finally:
            if self._file is not None:
                self._file.close()

    def __enter__(self) -> MetricsWriter:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


def finite(value: Any) -> float | None:
    """The value where it is a finite number, and no truth value: a job may have written anything into its records."""
    is_number = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
    return float(value) if is_number else None


def warnings_of(record: Mapping[str, Any], run: str) -> list[str]:
    """What a record says against its training, with the name of its ``run``; a job may have written anything into it."""
    found = record.get("warnings")
    texts = [text for text in found if isinstance(text, str)] if isinstance(found, list) else []
    return [text.replace(THIS_RUN, f"{run}@") for text in texts]


def scalars(record: Mapping[str, Any]) -> dict[str, float]:
    """A record's numbers by their names in TensorBoard, W&B and MLflow; without the iteration, which is the step, and the time."""
    numbers = {name: value for name, value in record.items() if isinstance(value, int | float)}
    return {
        _SECTIONS.get(name, f"train/{name}"): value
        for name, value in numbers.items()
        if name not in ("iteration", "time") and math.isfinite(value)
    }


def read_metrics(run: Run, after: int = 0) -> list[dict[str, Any]]:
    """The run's history: one record per iteration, in order, for iterations greater than ``after``. Raises OSError.

    If an iteration has several records, the later epoch's counts. A last line that a crash cut short is skipped.
    """
    history = MetricsHistory(run)
    found = history.after(after)
    while history.behind:
        found = history.after(after)
    return found


@lru_cache(maxsize=256)
def history_of(run: Run) -> MetricsHistory:
    """The run's history, cached between calls, for callers that poll."""
    return MetricsHistory(run)


def sampled(run: Run, most: int = 60, until_epoch: int | None = None) -> list[dict[str, Any]]:
    """At most ``most`` records of the run's history, spread evenly over its bytes, in order; the newest is the last. Raises OSError.

    Reads that many lines, however long the history is, and keeps nothing. ``until_epoch``: the last epoch whose records count.
    """
    found: dict[int, dict[str, Any]] = {}
    limit: float = math.inf
    files = sorted(_files(run), reverse=True)
    paths = [path for epoch, path in files if until_epoch is None or epoch <= until_epoch]
    sizes = [path.stat().st_size for path in paths]
    for path, size in zip(paths, sizes, strict=True):
        records, resumed_from = _sampled(path, size, max(2, most * size // max(1, sum(sizes))))
        found = {iteration: each for iteration, each in records.items() if iteration <= limit} | found
        limit = min(limit, resumed_from)
    order = sorted(found)
    step = max(1.0, (len(order) - 1) / max(1, most - 1))
    chosen = {round(i * step) for i in range(most)} if step > 1 else range(len(order))
    return [found[order[i]] for i in sorted(chosen) if i < len(order)]


def _sampled(path: Path, size: int, most: int) -> tuple[dict[int, dict[str, Any]], float]:
    """Records of a file by iteration, and the iteration from which it goes on (infinite where it does not say)."""
    found: dict[int, dict[str, Any]] = {}
    with open_regular(path) as file:
        first = file.readline(_LONGEST)
        begin, tail = len(first), max(0, size - _BLOCK)
        for place in range(most if tail else 0):  # of a short file all is read below
            if file.seek(begin + (size - begin) * place // most) > begin:
                file.readline(_LONGEST)  # the rest of a line
            _keep(found, file.readline(_LONGEST))
        if file.seek(max(begin, tail)) > begin:
            file.readline(_LONGEST)
        for line in file.read(2 * _BLOCK).splitlines(keepends=True)[-2 if tail else 0 :]:
            _keep(found, line)
    before = _record(first).get("resumed_from")
    return found, before if isinstance(before, int) else math.inf


def _keep(found: dict[int, dict[str, Any]], line: bytes) -> None:
    record = _record(line) if line.endswith(b"\n") else {}
    if isinstance(iteration := record.get("iteration"), int):
        found[iteration] = record


@dataclass
class _Section:
    """Records of one file whose iterations rise."""

    resumed_from: int | None
    """Earlier records count up to this iteration; None: all of them."""
    end: int
    """Byte after its last record."""
    last: int = 0
    """Its last iteration."""
    marks: list[tuple[int, int]] = field(default_factory=list)
    """Iteration and first byte of a record every 16 KiB."""


@dataclass
class _File:
    path: Path
    end: int = 0
    """Bytes of the whole lines read so far."""
    inside: bool = False
    """Whether ``end`` is inside a line that is too long."""
    identity: bytes = b""
    sections: list[_Section] = field(default_factory=list)

    def refresh(self, most: int) -> int:
        """Read the added lines, up to about ``most`` bytes; returns how many."""
        with open_regular(self.path) as file:
            head = file.read(_IDENTITY)
            if os.fstat(file.fileno()).st_size < self.end or not head.startswith(self.identity):
                self.end, self.inside, self.sections = 0, False, []
            file.seek(before := self.end)
            while self.end - before < most and (line := file.readline(_LONGEST)):
                whole = line.endswith(b"\n")
                if not whole and len(line) < _LONGEST:
                    break
                self._note({} if self.inside or not whole else _record(line), len(line))
                self.inside = not whole
            self.identity = head[: self.end]
            return self.end - before

    def _note(self, record: Mapping[str, Any], size: int) -> None:
        start, self.end = self.end, self.end + size
        iteration = record.get("iteration")
        if isinstance(before := record.get("resumed_from"), int):
            self.sections.append(_Section(before, self.end))
        elif isinstance(iteration, int):
            section = self.sections[-1] if self.sections else None
            if section is None or start - section.end > _LONGEST or (section.marks and iteration <= section.last):
                section = _Section(None, self.end)
                self.sections.append(section)
            if not section.marks or start - section.marks[-1][1] >= _BLOCK:
                section.marks.append((iteration, start))
            section.last, section.end = iteration, self.end

    def read(self, section: _Section, after: int, up_to: float) -> Iterator[tuple[int, dict[str, Any]]]:
        """The section's records from the last mark before ``after`` on, by iteration, up to that of ``up_to``."""
        place = max(0, bisect_right(section.marks, after, key=lambda mark: mark[0]) - 1)
        with open_regular(self.path) as file:
            position = file.seek(section.marks[place][1])
            while position < section.end and (line := file.readline(_LONGEST)):
                position += len(line)
                record = _record(line)
                if isinstance(iteration := record.get("iteration"), int):
                    if iteration > up_to:
                        return
                    yield iteration, record


class MetricsHistory:
    """A run's history, read incrementally. Thread-safe."""

    def __init__(self, run: Run) -> None:
        self.behind = False
        """Whether there is more than the last look read."""
        self._run = run
        self._lock = threading.Lock()
        self._known: dict[Path, _File] = {}

    def after(self, iteration: int = 0, most: int | None = None) -> list[dict[str, Any]]:
        """As :func:`read_metrics`, the first ``most`` records; reads 16 KiB plus these. Raises OSError.

        New lines are read in parts, see :attr:`behind`.
        """
        found: dict[int, dict[str, Any]] = {}
        with self._lock:
            limit: float = math.inf
            for file, section in reversed(self._refresh()):
                if section.marks and min(section.last, limit) > iteration:
                    records = file.read(section, iteration, limit)
                    later = (each for each in records if each[0] > iteration)
                    found = dict(islice(later, most)) | found  # the later section counts
                if section.resumed_from is not None:
                    limit = min(limit, section.resumed_from)
        return [found[i] for i in sorted(found)[:most]]

    def last(self) -> dict[str, Any] | None:
        """The newest record; None without any. Raises OSError."""
        with self._lock:
            newest = 0
            for _, section in self._refresh():
                newest = newest if section.resumed_from is None else min(newest, section.resumed_from)
                newest = max(newest, section.last)
        records = self.after(newest - 1) or self.after()
        return records[-1] if records else None

    def _refresh(self) -> list[tuple[_File, _Section]]:
        paths = [path for _, path in sorted(_files(self._run))]
        self._known = {path: self._known.get(path) or _File(path) for path in paths}
        room = _LOOK
        for file in self._known.values():
            room -= file.refresh(room)
        self.behind = room <= 0
        return [(file, section) for file in self._known.values() for section in file.sections]


def _files(run: Run) -> list[tuple[int, Path]]:
    try:
        with os.scandir(run.metrics) as entries:
            names = [entry.name for entry in entries if entry.is_file(follow_symlinks=False)]
    except (FileNotFoundError, NotADirectoryError):
        return []
    return [(int(match[1]), run.metrics / name) for name in names if (match := _NAME.fullmatch(name))]


def _record(line: bytes) -> dict[str, Any]:
    """The record of a line; empty if it is damaged."""
    try:
        return json_object(line, "record")
    except DamagedFile:
        return {}
