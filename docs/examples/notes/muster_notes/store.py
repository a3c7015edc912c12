"""Notes in the store: ``notes/<run>``, a JSON file for each run that has some."""

from shared_store.volume.files import read_json, write_json
from shared_store.volume.layout import Store, names_in
from shared_store.volume.references import Found, needed_run


def add(store: Store, run: str, text: str) -> None:
    """Add a note on a run. Raises StoreError for a name that no run has, OSError."""
    path = store.path / "notes" / store.run(run).name
    path.parent.mkdir(exist_ok=True)
    write_json(path, {"notes": [*(read_json(path) or {}).get("notes", []), text]})


def notes(store: Store) -> dict[str, list[str]]:
    """All notes by run. Raises DamagedFile, OSError."""
    found = {run: read_json(store.path / "notes" / run) or {} for run in names_in(store.path / "notes")}
    return {run: document.get("notes", []) for run, document in found.items()}


def references(store: Store) -> Found:
    """A run with a note is not deleted."""
    for run in notes(store):
        yield from needed_run(run, "there is a note on it")
