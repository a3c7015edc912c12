"""What in the store needs which run: models, entries of leagues, clones, and policies that imitate a teacher.

A new kind of thing that needs runs adds a function to :data:`REFERRERS`.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from typing import Any, Literal, NamedTuple

from shared_store import leagues, models
from shared_store.bundles import DamagedBundle
from shared_store.files import DamagedFile, read_json
from shared_store.layout import LARGEST_DESCRIPTION, NAME, Store, names_in
from shared_store.leagues import LeagueError
from shared_store.models import ModelError


class Needed(NamedTuple):
    """Something needs a run or a job."""

    kind: Literal["run", "job"]
    name: str
    by: str
    """What needs it, as a clause: ``model ant@2 is of it``."""


class Unreadable(NamedTuple):
    """What can't be read, and so may need any run; one clause that names it and says why."""

    why: str


Found = Iterator[Needed | Unreadable]


def references(store: Store) -> tuple[list[Needed], list[str]]:
    """All that in the store needs a run or a job, and what could not be read. Raises OSError where the volume can't be read."""
    needed: list[Needed] = []
    unreadable: list[str] = []
    for referrer in REFERRERS:
        for each in referrer(store):
            if isinstance(each, Needed):
                needed.append(each)
            else:
                unreadable.append(each.why)
    return needed, unreadable


def _of_models(store: Store) -> Found:
    """Runs of models, with those from which their weights began."""
    try:
        names = names_in(store.models)
    except DamagedFile as error:
        yield Unreadable(f"{error}")
        return
    for name in names:
        try:
            found = models.versions(store, name)
        except (ModelError, DamagedFile) as error:
            yield Unreadable(f"model {name} can't be read ({error})")
            continue
        for model in found:
            try:
                facts = model.facts()
            except DamagedBundle as error:
                yield Unreadable(str(error))
                continue
            yield from _run(facts.get("run"), f"model {model.reference} is of it")
            yield from _run(_part(facts.get("parent"), "run"), f"model {model.reference} began with its weights")


def _of_leagues(store: Store) -> Found:
    """Evaluations that entries of leagues cite, with the jobs that made them. Entries need not be sound to be kept."""
    try:
        found = leagues.names(store)
    except LeagueError as error:
        yield Unreadable(str(error))
        return
    for name in found:
        folder = store.leagues / name / "entries"
        try:
            numbers = names_in(folder)
        except DamagedFile as error:
            yield Unreadable(str(error))
            continue
        for number in numbers:
            path = folder / number / "entry.json"
            try:
                entry = read_json(path)
            except (DamagedFile, NotADirectoryError) as error:
                yield Unreadable(f"entry {number} of league {name} can't be read ({error})")
                continue
            if entry is None:
                yield Unreadable(f"entry {number} of league {name} can't be read ({path} is missing)")
                continue
            evaluation, by = entry.get("evaluation"), f"entry {number} of league {name} cites it"
            yield from _run(_part(evaluation, "run"), by)
            if isinstance(job := _part(evaluation, "job"), str):
                yield Needed("job", job, by)


def _of_runs(store: Store) -> Found:
    """Runs that began with the weights of another, and those that hold the weights of a teacher."""
    try:
        entries = [entry.name for entry in os.scandir(store.path / "runs") if NAME.fullmatch(entry.name)]
    except FileNotFoundError:
        return
    for name in entries:
        path = store.path / "runs" / name
        if os.path.lexists(path / "parent"):
            try:
                described = read_json(path / "run.json", LARGEST_DESCRIPTION) or {}
            except DamagedFile as error:
                yield Unreadable(f"run {name} can't be read ({error})")
            else:
                yield from _run(_part(described.get("parent"), "run"), f"run {name} is a clone of it")
        if os.path.lexists(path / "teachers"):
            try:
                taught = names_in(path / "teachers")
            except (DamagedFile, NotADirectoryError) as error:
                yield Unreadable(f"run {name}: its teachers can't be read ({error})")
            else:
                for teacher in taught:
                    yield from _run(teacher, f"it is the teacher of run {name}")


REFERRERS: tuple[Callable[[Store], Found], ...] = (_of_models, _of_leagues, _of_runs)


def _part(value: Any, key: str) -> Any:
    return value.get(key) if isinstance(value, dict) else None


def _run(name: Any, by: str) -> Found:
    if isinstance(name, str):
        yield Needed("run", name, by)
