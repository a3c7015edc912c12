"""Folders of plug-ins in the store: noted in ``plugins.json``, so that nothing is deleted that a plug-in needs which is not installed."""

from __future__ import annotations

from collections.abc import Iterator

from shared_store.contract.plugins import plugins
from shared_store.volume.files import is_there, read_json, write_json
from shared_store.volume.layout import Store

_FILE = "plugins.json"


def note_plugins(store: Store) -> None:
    """Note the folders of the installed plug-ins. Raises DamagedFile and OSError."""
    noted = read_json(store.path / _FILE) or {}
    there = noted | {name: list(plugin.folders) for name, plugin in plugins().items() if plugin.folders}
    if there != noted:
        write_json(store.path / _FILE, there)


def orphans(store: Store) -> Iterator[str]:
    """For each plug-in that is not installed and has folders in the store: a clause that says so. Raises DamagedFile and OSError."""
    for name, folders in (read_json(store.path / _FILE) or {}).items():
        there = [folder for folder in folders if is_there(store.path / folder)]
        if there and name not in plugins():
            yield (
                f"what the store's {', '.join(there)} need can't be known without the plug-in {name}; install it, or move them away"
            )
