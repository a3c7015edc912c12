"""``python -m racer.tracks ORDER``: what ``muster tracks`` asks for, as JSON in and out, since it imports no numpy itself."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from racer.store import tracks as stored
from racer.tracks.generator import make_random
from racer.tracks.naming import keep, resolve
from racer.tracks.presets import PRESETS, make_preset
from racer.tracks.race_track import Track
from racer.tracks.route_file import read_file, to_bytes
from shared_store.volume.files import EVERY_LEVEL, write_atomic
from shared_store.volume.layout import Store
from worker.settings.errors import UserError

Order = dict[str, Any]


def list_tracks(order: Order) -> list[Order]:
    """All tracks, the presets first; one that is damaged has a ``problem`` instead of measures.

    ``store``: where they lie; ``rings``: whether each track has its borders, too.
    """
    store, found = Store(order["store"]), []
    for name in PRESETS:
        track = make_preset(name)
        found.append({**_facts(order, track), "origin": {"preset": name}, "about": PRESETS[name].about})
    for name in stored.names(store):
        try:
            track = resolve(name, store)
            found.append({**stored.StoredTrack(stored.folder_in(store) / name).facts(), **_facts(order, track)})
        except (stored.TrackError, UserError) as error:
            found.append({"name": name, "problem": str(error)})
    return found


def _facts(order: Order, track: Track) -> Order:
    """Measures of a track; they come from its points, also where another version kept others beside them."""
    return {**track.facts(), **(_rings(track) if order.get("rings") else {})}


def _rings(track: Track) -> Order:
    """The borders in driving order and the ends of the start line, as pairs [m] rounded to centimetres; for drawings."""
    lines = {"inner": track.inner, "outer": track.outer, "start": np.stack([border[0] for border in track.beside])}
    return {"rings": {name: line.round(2).tolist() for name, line in lines.items()}}


def show(order: Order) -> Order:
    """A track's measures; writes it to ``output`` where one is named. ``name``, ``store``, ``rings``."""
    store = Store(order["store"])
    track = resolve(order["name"], store)
    _write(order, _content(order, track))
    if track.name not in stored.names(store):
        return _facts(order, track)
    kept = stored.find(store, track.name)
    return {**kept.facts(), **_facts(order, track), "path": str(kept.path)}


def make(order: Order) -> Order:
    """Make a track with ``measures`` of a ``preset`` or a ``seed``, and keep it under ``name`` in ``store``."""
    name, measures = order["name"], order["measures"]
    if order.get("preset") is not None:
        return _kept(order, make_preset(order["preset"], name, **measures), {"preset": order["preset"], **measures})
    return _kept(order, make_random(order["seed"], name, **measures), {"seed": order["seed"], **measures})


def import_file(order: Order) -> Order:
    """Keep the track in ``file`` under ``name`` in ``store``; the ``notes`` of its origin say what was mended."""
    path = Path(order["file"])
    found = read_file(path, order["name"])
    return _kept(order, found.track, {"file": path.name, "notes": list(found.notes)})


def _kept(order: Order, track: Track, origin: Order) -> Order:
    store = Store(order["store"])
    content = _content(order, track)
    try:
        kept = keep(store, track, origin)
    except OSError as error:
        raise UserError(
            f"track {track.name} can't be kept in {stored.folder_in(store)}: {error.strerror or error}"
        ) from None
    _write(order, content)
    return {**kept.facts(), "path": str(kept.path)}


def _content(order: Order, track: Track) -> bytes:
    """A picture, or the track itself, as the ending of ``output`` says; nothing without one."""
    if not order.get("output"):
        return b""
    if order["output"].endswith(".npy"):
        return to_bytes(track)
    from racer.tracks.picture import picture_of

    try:
        return picture_of(track)
    except ImportError as error:
        raise UserError(f"a picture needs matplotlib ({error}): pip install 'muster[worker]'") from None


def _write(order: Order, content: bytes) -> None:
    if order.get("output"):
        try:
            write_atomic(Path(order["output"]), content, levels=EVERY_LEVEL)
        except OSError as error:
            raise UserError(f"-o {order['output']}: it can't be written ({error.strerror or error})") from None


ACTIONS: dict[str, Callable[[Order], Any]] = {"list": list_tracks, "show": show, "make": make, "import": import_file}


def main(order: Order) -> int:
    """Do what ``order["action"]`` says and print the result; returns the exit code: 2 where the user's line on stderr says why."""
    try:
        print(json.dumps(ACTIONS[order["action"]](order)))
    except (UserError, stored.TrackError) as error:
        print(error, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main(json.loads(sys.argv[1])))
