"""The numbers of a run, one JSON line an iteration, one file an epoch.

An attempt that resumes from iteration k supersedes what earlier attempts wrote after k, so that a run has one history: no
iteration twice, none from a past that was given up.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any

from shared_store.layout import Run

_NAME = re.compile(r"metrics-e(\d+)\.jsonl")


class MetricsWriter:
    """Appends the metrics of one attempt; one writer a file, on the main node."""

    def __init__(self, run: Run, epoch: int, resumed_from: int) -> None:
        """Open the file of ``epoch``; ``resumed_from`` is the number of iterations already done (0 for a new run)."""
        run.metrics.mkdir(parents=True, exist_ok=True)
        self.path = run.metrics / f"metrics-e{epoch}.jsonl"
        self._file = open(self.path, "a", buffering=1)  # noqa: SIM115 - closed by close()
        self.write({"resumed_from": resumed_from})

    def write(self, record: Mapping[str, Any]) -> None:
        """Append one record; ``iteration`` counts from 1. A value that is not finite must be given as None."""
        self._file.write(json.dumps(record, allow_nan=False) + "\n")

    def close(self) -> None:
        self._file.close()

    def __enter__(self) -> MetricsWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def read_metrics(run: Run, after: int = 0) -> list[dict[str, Any]]:
    """The run's history: one record an iteration, in order, for iterations greater than ``after``.

    For an iteration seen twice the later epoch counts. A last line that a crash cut short is passed over.
    """
    history: dict[int, dict[str, Any]] = {}
    for _, path in sorted(_files(run)):
        for record in _records(path):
            if "resumed_from" in record:
                history = {i: r for i, r in history.items() if i <= record["resumed_from"]}
            elif isinstance(record.get("iteration"), int):
                history[record["iteration"]] = record
    return [history[i] for i in sorted(history) if i > after]


def _files(run: Run) -> list[tuple[int, Path]]:
    try:
        entries = list(run.metrics.iterdir())
    except FileNotFoundError:
        return []
    return [(int(match[1]), path) for path in entries if (match := _NAME.fullmatch(path.name))]


def _records(path: Path) -> list[dict[str, Any]]:
    records = []
    for line in path.read_bytes().split(b"\n")[:-1]:
        try:
            record = json.loads(line)
        except ValueError:
            continue
        if isinstance(record, dict):
            records.append(record)
    return records
