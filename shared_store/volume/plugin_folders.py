"""Folders of plug-ins in the store: noted in ``plugins.json``, so that nothing is deleted that a plug-in needs which is not installed."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from shared_store.contract.error_text import shown
from shared_store.contract.plugins import plugins
from shared_store.volume.files import DamagedFile, is_there, read_json, write_json
from shared_store.volume.layout import NAME, Store

_FILE = "plugins.json"


@dataclass(frozen=True)
class Orphan:
    """A plug-in that is not installed, and whose folders are in the store."""

    name: str
    """Of the plug-in."""
    folders: tuple[Path, ...]

    def __str__(self) -> str:
        """What follows, and what to do, in one line."""
        several = len(self.folders) > 1
        return (
            f"plug-in {shown(self.name)} is not installed, so what its {'folders' if several else 'folder'} "
            f"{' and '.join(map(str, self.folders))} {'need' if several else 'needs'} can't be known; "
            f"install the package that brings it, or move the {'folders' if several else 'folder'} out of the store"
        )


def note_plugins(store: Store) -> None:
    """Note the folders of the installed plug-ins. Raises DamagedFile and OSError."""
    noted = read_json(store.path / _FILE) or {}
    there = noted | {name: list(plugin.folders) for name, plugin in plugins().items() if plugin.folders}
    if there != noted:
        write_json(store.path / _FILE, there)


def orphans(store: Store) -> Iterator[Orphan]:
    """The plug-ins that are not installed and have folders in the store. Raises DamagedFile and OSError."""
    path = store.path / _FILE
    for name, folders in (read_json(path) or {}).items():
        if name in plugins():
            continue
        if not isinstance(folders, list) or not all(isinstance(each, str) and NAME.fullmatch(each) for each in folders):
            raise DamagedFile(
                f'{path}: {shown(name)}: expected a list of names of folders, such as ["notes"]; correct it, or remove the entry'
            )
        if there := tuple(store.path / each for each in folders if is_there(store.path / each)):
            yield Orphan(name, there)
