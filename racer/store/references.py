"""References of leagues to runs and jobs: each entry cites the evaluation of its race."""

from __future__ import annotations

from pathlib import Path

from racer.store import leagues
from racer.store.leagues import LeagueError
from shared_store.volume.files import read_json
from shared_store.volume.layout import Store, names_in
from shared_store.volume.references import Found, Needed, Unreadable, needed_run, part, read


def references(store: Store) -> Found:
    """Evaluations that entries of leagues cite, with the jobs that made them. Entries need not be sound to be kept."""
    try:
        names = leagues.names(store)
    except LeagueError as error:
        yield Unreadable(f"leagues can't be read ({error})")
        return
    for name in names:
        yield from read(f"league {name}", _of_entries, name, leagues.folder_in(store) / name / "entries")


def _of_entries(league: str, folder: Path) -> Found:
    for number in names_in(folder):
        path = folder / number / "entry.json"
        yield from read(f"entry {number} of league {league}", _of_entry, league, number, path)


def _of_entry(league: str, number: str, path: Path) -> Found:
    entry = read_json(path)
    if entry is None:
        yield Unreadable(f"entry {number} of league {league} can't be read ({path} is missing)")
        return
    evaluation, by = entry.get("evaluation"), f"entry {number} of league {league} cites it"
    yield from needed_run(part(evaluation, "run"), by)
    if isinstance(job := part(evaluation, "job"), str):
        yield Needed("job", job, by)
