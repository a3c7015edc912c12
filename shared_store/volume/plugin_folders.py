"""Folders of plug-ins in the store: noted in ``plugins.json``, so that nothing is deleted that a plug-in needs which is not installed."""

from __future__ import annotations

from collections.abc import Iterator

from shared_store.contract.error_text import shown
from shared_store.contract.plugins import plugins
from shared_store.volume.files import DamagedFile, path_exists, read_json, write_json
from shared_store.volume.layout import NAME, Store

_FILE = "plugins.json"


def note_plugins(store: Store) -> None:
    """Note the folders of the installed plug-ins. Raises DamagedFile and OSError."""
    noted = read_json(store.path / _FILE) or {}
    existing = noted | {name: list(plugin.folders) for name, plugin in plugins().items() if plugin.folders}
    if existing != noted:
        write_json(store.path / _FILE, existing, levels=0)


def orphans(store: Store) -> Iterator[str]:
    """One line for each plug-in that is not installed and has folders in the store, with what to do. Raises DamagedFile and OSError."""
    path = store.path / _FILE
    for name, folders in (read_json(path) or {}).items():
        if name in plugins():
            continue
        if not isinstance(folders, list) or not all(isinstance(each, str) and NAME.fullmatch(each) for each in folders):
            raise DamagedFile(
                f'{path}: {shown(name)}: expected a list of names of folders, such as ["notes"]; correct it, or remove the entry'
            )
        if existing := [str(store.path / each) for each in folders if path_exists(store.path / each)]:
            noun, verb = ("folder", "needs") if len(existing) == 1 else ("folders", "need")
            yield (
                f"plug-in {shown(name)} is not installed, so what its {noun} {' and '.join(existing)} {verb} can't be known; "
                f"install the package that brings it, or move the {noun} out of the store"
            )
