"""References to runs in the store: from models, entries of leagues, clones, and policies that imitate a teacher.

A new kind of thing that needs runs adds a function to :data:`REFERRERS`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Literal, NamedTuple

from racer.store import leagues
from racer.store.leagues import LeagueError
from shared_store.volume import models
from shared_store.volume.bundles import DamagedBundle
from shared_store.volume.files import DamagedFile, is_there, read_json
from shared_store.volume.layout import LARGEST_DESCRIPTION, Store, names_in
from shared_store.volume.models import Model, ModelError


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
    """All that in the store needs a run or a job, and what could not be read."""
    needed: list[Needed] = []
    unreadable: list[str] = []
    for what, referrer in REFERRERS.items():
        for each in _read(what, referrer, store):
            if isinstance(each, Needed):
                needed.append(each)
            else:
                unreadable.append(each.why)
    return needed, unreadable


def _read(what: str, referrer: Callable[..., Found], *arguments: Any) -> Found:
    """What a referrer finds, with what it can't read."""
    try:
        yield from referrer(*arguments)
    except DamagedBundle as error:  # which names the model
        yield Unreadable(str(error))
    except (DamagedFile, LeagueError, ModelError, OSError) as error:
        yield Unreadable(f"{what} can't be read ({error})")


def _of_models(store: Store) -> Found:
    """Runs of models, with those from which their weights began."""
    for name in names_in(store.models):
        yield from _read(f"model {name}", _of_versions, store, name)


def _of_versions(store: Store, name: str) -> Found:
    for model in models.versions(store, name):
        yield from _read(f"model {model.reference}", _of_model, model)


def _of_model(model: Model) -> Found:
    facts = model.facts()
    yield from _run(facts.get("run"), f"model {model.reference} is of it")
    yield from _run(_part(facts.get("parent"), "run"), f"model {model.reference} began with its weights")


def _of_leagues(store: Store) -> Found:
    """Evaluations that entries of leagues cite, with the jobs that made them. Entries need not be sound to be kept."""
    for name in leagues.names(store):
        yield from _read(f"league {name}", _of_entries, name, store.leagues / name / "entries")


def _of_entries(league: str, folder: Path) -> Found:
    for number in names_in(folder):
        yield from _read(
            f"entry {number} of league {league}", _of_entry, league, number, folder / number / "entry.json"
        )


def _of_entry(league: str, number: str, path: Path) -> Found:
    entry = read_json(path)
    if entry is None:
        yield Unreadable(f"entry {number} of league {league} can't be read ({path} is missing)")
        return
    evaluation, by = entry.get("evaluation"), f"entry {number} of league {league} cites it"
    yield from _run(_part(evaluation, "run"), by)
    if isinstance(job := _part(evaluation, "job"), str):
        yield Needed("job", job, by)


def _of_runs(store: Store) -> Found:
    """Runs that began with the weights of another, and those that hold the weights of a teacher."""
    for name in names_in(store.path / "runs"):
        yield from _read(f"run {name}", _of_run, name, store.path / "runs" / name)


def _of_run(name: str, path: Path) -> Found:
    if is_there(path / "parent"):
        described = read_json(path / "run.json", LARGEST_DESCRIPTION) or {}
        yield from _run(_part(described.get("parent"), "run"), f"run {name} is a clone of it")
    if is_there(path / "teachers"):
        for teacher in names_in(path / "teachers"):
            yield from _run(teacher, f"it is the teacher of run {name}")


REFERRERS: dict[str, Callable[[Store], Found]] = {"models": _of_models, "leagues": _of_leagues, "runs": _of_runs}


def _part(value: Any, key: str) -> Any:
    return value.get(key) if isinstance(value, dict) else None


def _run(name: Any, by: str) -> Found:
    if isinstance(name, str):
        yield Needed("run", name, by)
