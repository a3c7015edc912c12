"""The contents of a run's directory: Muster's records, logs of jobs, results; and whether the run is archived.

Everything that is not known here counts as a result: a program may leave files of any name in its run.
"""

from __future__ import annotations

import os
import re
import stat
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from shared_store.volume.files import DamagedFile, read_json, write_json
from shared_store.volume.layout import Run

ARCHIVED = "archived.json"
OF_JOBS = ("logs", "outcomes")
"""Directories with a directory for each job."""
_CLAIM = re.compile(r"EPOCH\.([0-9]{1,15})")
_RECORDS = re.compile(r"run\.json|EPOCH|texts|\..*\.tmp|" + re.escape(ARCHIVED))


@dataclass(frozen=True)
class Contents:
    """What a run holds."""

    results: tuple[str, ...]
    """Names of files and of directories with something in them, sorted."""
    logged: frozenset[str]
    """Jobs that have left logs or outcomes."""
    epoch: int
    """The highest that a controller has claimed, whether it is published yet or not; 0 before the first."""


def contents(run: Run) -> Contents:
    """What the run holds now. Raises FileNotFoundError where it does not exist, DamagedFile for a link in its place, OSError."""
    run.check_links()
    if run.path.is_symlink():
        raise DamagedFile(f"{run.path}: a link, and links inside a run are not followed")
    results, epoch = [], 0
    logged: set[str] = set()
    for entry in sorted(os.scandir(run.path), key=lambda entry: entry.name):
        if claim := _CLAIM.fullmatch(entry.name):
            epoch = max(epoch, int(claim[1]))
        elif entry.name in OF_JOBS and entry.is_dir(follow_symlinks=False):
            jobs = {each.name for each in os.scandir(entry.path) if each.is_dir(follow_symlinks=False)}
            logged |= jobs
            results += [f"{entry.name}/{name}" for name in sorted({*os.listdir(entry.path)} - jobs)]
        elif not _RECORDS.fullmatch(entry.name) and (not entry.is_dir(follow_symlinks=False) or _has_files(entry.path)):
            results.append(entry.name)
    return Contents(tuple(results), frozenset(logged), epoch)


def _has_files(directory: str) -> bool:
    """Whether anything but directories lies below it; one that can't be read may have something."""
    unreadable: list[OSError] = []
    for folder, folders, names in os.walk(directory, onerror=unreadable.append):
        if names or any(os.path.islink(os.path.join(folder, each)) for each in folders):
            return True
    return bool(unreadable)


def archived(run: Run) -> dict[str, Any] | None:
    """Who has archived the run (``by``) and when (``at``, Unix time [s]); None where it is not. Damage counts as archived. Raises OSError."""
    try:
        return read_json(run.path / ARCHIVED)
    except DamagedFile:
        return {}


def is_archived(run: Run) -> bool:
    """Whether the run is archived; for lists. Raises nothing."""
    return os.path.lexists(run.path / ARCHIVED)


def archive(run: Run, by: str) -> None:
    """Archive a run that exists. Raises OSError, DamagedFile for a link in its place."""
    run.check_links()
    write_json(run.path / ARCHIVED, {"by": by, "at": time.time()}, levels=0)


def unarchive(run: Run) -> None:
    """Take the run out of the archive. Raises OSError, DamagedFile for a link in its place."""
    run.check_links()
    (run.path / ARCHIVED).unlink(missing_ok=True)


def job_directories(run: Run, job: str) -> Iterator[Path]:
    """Those of a job in the run: its logs and outcomes."""
    for name in OF_JOBS:
        path = run.path / name / job
        with suppress(OSError):
            if stat.S_ISDIR(os.lstat(path).st_mode):
                yield path
