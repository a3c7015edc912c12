"""Notes in the store: ``notes/<run>.json``."""

from shared_store.volume.files import read_json, write_json
from shared_store.volume.layout import Store, names_in
from shared_store.volume.references import Found, needed_run


def add(store: Store, run: str, text: str) -> None:
    """Add a note on a run. Raises StoreError for a name that no run has, OSError."""
    path = store.path / "notes" / f"{store.run(run).name}.json"
    path.parent.mkdir(exist_ok=True)
    write_json(path, {"run": run, "notes": [*(read_json(path) or {"notes": []})["notes"], text]})


def notes(store: Store) -> list[dict[str, object]]:
    """All notes by run. Raises DamagedFile, OSError."""
    return [read_json(store.path / "notes" / name) or {} for name in names_in(store.path / "notes")]


def references(store: Store) -> Found:
    """A run with a note is not deleted."""
    for note in notes(store):
        yield from needed_run(note.get("run"), "there is a note on it")
