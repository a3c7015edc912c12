"""The naming of tracks in a job: a preset (``oval``), a seed (``random:7``), or a name in the store."""

from __future__ import annotations

from typing import Any

from racer.store import tracks as stored
from racer.tracks.checks import BadTrack
from racer.tracks.generator import LARGEST_SEED, make_random
from racer.tracks.presets import PRESETS, make_preset
from racer.tracks.race_track import Track
from racer.tracks.route_file import from_bytes, to_bytes
from shared_store.contract.error_text import nearest, shown
from shared_store.volume.layout import Store

RANDOM = "random:"


def resolve(name: str, store: Store | None) -> Track:
    """The track that ``name`` means.

    Args:
        name: A preset, ``random:SEED``, or the name of a track in the store.
        store: Where imported and made tracks lie; None where there are none.

    Raises:
        BadTrack: There is no such track, or that of the store is damaged; the message names the nearest one.
    """
    if name in PRESETS:
        return make_preset(name)
    if name.startswith(RANDOM):
        seed = name.removeprefix(RANDOM)
        if not (seed.isascii() and seed.isdecimal() and len(seed) < 20 and int(seed) <= LARGEST_SEED):
            raise BadTrack(
                f"track {shown(name)}: after {RANDOM} stands an integer from 0 to {LARGEST_SEED}, such as {RANDOM}7"
            )
        return make_random(int(seed))
    try:
        known = stored.names(store) if store is not None else []
        if store is None or name not in known:
            hint = nearest(name, [*PRESETS, *known, f"{RANDOM}7"])
            raise BadTrack(f"track {shown(name)}: there is no such track; {hint}")
        data = stored.find(store, name).read()
    except stored.TrackError as error:
        raise BadTrack(str(error)) from None
    try:
        return from_bytes(data, name).track
    except BadTrack as error:  # what another version kept
        raise BadTrack(f"track {name}: {error}") from None


def keep(store: Store, track: Track, origin: dict[str, Any]) -> stored.StoredTrack:
    """Put a track into the store under its name, for good.

    Args:
        store: Where it is to lie.
        track: The track.
        origin: Where it comes from, as JSON values.

    Raises:
        BadTrack: No track can be called so, or one is.
        OSError: The volume is full or gone.
    """
    if track.name in PRESETS:
        raise BadTrack(f"track {track.name}: a preset is called so; choose another name")
    try:
        return stored.add(store, track.name, to_bytes(track), {**track.facts(), "origin": origin})
    except stored.TrackError as error:
        raise BadTrack(str(error)) from None
