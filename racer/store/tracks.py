"""Tracks of the racer: ``tracks/<name>/``, each immutable.

A track is ``track.npy`` (rows of centre, inner and outer x and y [m], the last row repeats the first) and ``manifest.json`` with the
file's digest, the track's measures and its origin. It appears by a rename that fails if the name exists.
"""

from __future__ import annotations

import re
import time
import uuid
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from shared_store.contract.error_text import nearest
from shared_store.volume import bundles
from shared_store.volume.bundles import DamagedBundle
from shared_store.volume.files import DamagedFile, open_regular, refuse_links
from shared_store.volume.layout import Store, check_name, names_in

FILE = "track.npy"
LARGEST = 1 << 20
"""Bytes of a track's file, here and at an import."""
PRESETS = ("oval", "rounded-rectangle", "chicane")
"""Tracks outside the store (:mod:`racer.tracks.presets`)."""
_DRAWN = re.compile(r"random:([0-9]{1,19})")
"""A track drawn from a seed (:mod:`racer.tracks.naming`)."""


class TrackError(Exception):
    """A track does not exist, can't be stored, or is damaged; one line."""


@dataclass(frozen=True)
class StoredTrack:
    """A track of the store."""

    path: Path

    @property
    def name(self) -> str:
        return self.path.name

    def facts(self) -> dict[str, Any]:
        """Its measures and origin. Raises TrackError if the description is damaged."""
        try:
            refuse_links(self.path, 2)
            found: dict[str, Any] = bundles.read_manifest(self.path)["track"]
        except (DamagedBundle, DamagedFile, KeyError) as error:
            raise self._damaged(error) from None
        return found

    def read(self) -> bytes:
        """The content of ``track.npy``. Raises TrackError if any part of the track is altered or missing."""
        try:
            refuse_links(self.path, 2)
            bundles.verify(self.path)
            with open_regular(self.path / FILE) as file:
                return file.read(LARGEST)
        except (DamagedBundle, DamagedFile, OSError) as error:
            raise self._damaged(error) from None

    def _damaged(self, error: Exception) -> TrackError:
        return TrackError(f"track {self.name} is damaged: {error}; delete {self.path} and make or import it again")


def folder_in(store: Store) -> Path:
    """Where the tracks of a store are."""
    return store.path / "tracks"


def names(store: Store) -> list[str]:
    """Names of all tracks. Raises TrackError for a link where the directory should be."""
    try:
        return names_in(folder_in(store))
    except (DamagedFile, OSError) as error:
        raise TrackError(str(error)) from None


def is_made(name: str) -> bool:
    """Whether a track of this name is a preset or drawn from a seed, and so not in the store."""
    drawn = _DRAWN.fullmatch(name)
    return name in PRESETS or (drawn is not None and int(drawn[1]) < 2**63)


def find(store: Store, name: str, others: Sequence[str] = ()) -> StoredTrack:
    """The track of that name. Raises TrackError with the nearest name.

    ``others``: further names that the caller could have meant.
    """
    known = names(store)
    if name not in known:
        near = [*others, *known]
        raise TrackError(
            f"track {name[:130]} does not exist; {nearest(name, near, '' if near else 'none is kept yet')}"
        )
    return StoredTrack(folder_in(store) / name)


def add(store: Store, name: str, data: bytes, facts: Mapping[str, Any]) -> StoredTrack:
    """Store a track under ``name``.

    Args:
        store: The store.
        name: Its name, which becomes a directory.
        data: Content of ``track.npy``.
        facts: Further entries of its manifest: measures, origin.

    Raises:
        TrackError: The name is invalid, or a track of that name exists.
        OSError: The volume is full or gone.
    """
    check_name("track", name, TrackError)
    track = StoredTrack(folder_in(store) / name)
    if name in names(store):
        raise _taken(track)
    try:
        with bundles.hidden_folder(folder_in(store) / f".{uuid.uuid4().hex}.tmp") as hidden:
            (hidden / FILE).write_bytes(data)
            bundles.seal(hidden, {"track": {**facts, "name": name, "created": time.time()}})
            for file in hidden.iterdir():
                file.chmod(0o444)
            bundles.publish(hidden, track.path)
    except FileExistsError:  # another was faster
        raise _taken(track) from None
    return track


def _taken(track: StoredTrack) -> TrackError:
    return TrackError(f"track {track.name} exists already, and tracks are immutable; choose another name")
