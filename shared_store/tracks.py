"""Tracks of the racer: ``tracks/<name>/``, each written once and never again.

A track is ``track.npy`` (rows of centre, inner and outer x and y [m], the last row is the first) and ``manifest.json`` with the file's
digest, the track's measures, and where it comes from. It appears by a rename that fails where there is one of that name already.
"""

from __future__ import annotations

import re
import shutil
import time
import uuid
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from shared_store import bundles
from shared_store.bundles import DamagedBundle
from shared_store.files import DamagedFile, open_regular, refuse_links
from shared_store.layout import NAME, Store, names_in
from shared_store.wording import nearest

FILE = "track.npy"
LARGEST = 1 << 20
"""Bytes of a track's file, here and where one is imported."""
PRESETS = ("oval", "rounded-rectangle", "chicane")
"""Tracks that lie in no store (:mod:`worker.racer.presets`)."""
_DRAWN = re.compile(r"random:([0-9]{1,19})")
"""A track that is drawn from a seed (:mod:`worker.racer.naming`)."""


class TrackError(Exception):
    """There is no such track, it can't be kept, or it is damaged; one line."""


@dataclass(frozen=True)
class StoredTrack:
    """A track of the store."""

    path: Path

    @property
    def name(self) -> str:
        return self.path.name

    def facts(self) -> dict[str, Any]:
        """Its measures and origin, as they were kept. Raises TrackError where the description is damaged."""
        try:
            refuse_links(self.path, 2)
            found: dict[str, Any] = bundles.read_manifest(self.path)["track"]
        except (DamagedBundle, DamagedFile, KeyError) as error:
            raise self._damaged(error) from None
        return found

    def read(self) -> bytes:
        """The content of ``track.npy``, as it was kept. Raises TrackError where anything of the track is altered or missing."""
        try:
            refuse_links(self.path, 2)
            bundles.verify(self.path)
            with open_regular(self.path / FILE) as file:
                return file.read(LARGEST)
        except (DamagedBundle, DamagedFile, OSError) as error:
            raise self._damaged(error) from None

    def _damaged(self, error: Exception) -> TrackError:
        return TrackError(f"track {self.name} is damaged: {error}; delete {self.path} and make or import it again")


def names(store: Store) -> list[str]:
    """Names of all tracks. Raises TrackError for a link where the directory should be."""
    try:
        return names_in(store.tracks)
    except (DamagedFile, OSError) as error:
        raise TrackError(str(error)) from None


def is_made(name: str) -> bool:
    """Whether a track of this name is a preset or drawn from a seed, so that it is in no store."""
    drawn = _DRAWN.fullmatch(name)
    return name in PRESETS or (drawn is not None and int(drawn[1]) < 2**63)


def find(store: Store, name: str, others: Sequence[str] = ()) -> StoredTrack:
    """The track of that name. Raises TrackError with the nearest one where there is none.

    ``others``: what else the caller could have meant.
    """
    known = names(store)
    if name not in known:
        near = [*others, *known]
        raise TrackError(
            f"track {name[:130]} does not exist; {nearest(name, near, '' if near else 'none is kept yet')}"
        )
    return StoredTrack(store.tracks / name)


def add(store: Store, name: str, data: bytes, facts: Mapping[str, Any]) -> StoredTrack:
    """Keep a track under ``name``.

    Args:
        store: Where it is to lie.
        name: What it is to be called; it becomes a directory.
        data: Content of ``track.npy``.
        facts: What else its manifest says: measures, origin.

    Raises:
        TrackError: No track can be called so, or there is one already.
        OSError: The volume is full or gone.
    """
    if not NAME.fullmatch(name):
        raise TrackError(
            f"track name {name[:130]!r}: use letters, digits, '.', '_' and '-' only, at most 128 of them, the first a letter or digit"
        )
    track = StoredTrack(store.tracks / name)
    if name in names(store):
        raise _taken(track)
    store.tracks.mkdir(parents=True, exist_ok=True)
    hidden = store.tracks / f".{uuid.uuid4().hex}.tmp"
    try:
        hidden.mkdir()
        (hidden / FILE).write_bytes(data)
        bundles.seal(hidden, {"track": {**facts, "name": name, "created": time.time()}})
        for file in hidden.iterdir():
            file.chmod(0o444)
        bundles.publish(hidden, track.path)
    except FileExistsError:  # another was faster
        raise _taken(track) from None
    finally:
        shutil.rmtree(hidden, ignore_errors=True)
    return track


def _taken(track: StoredTrack) -> TrackError:
    return TrackError(f"track {track.name} exists already, and a track is never changed; choose another name")
