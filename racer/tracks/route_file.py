"""Tracks as ``.npy`` files in the form that the DeepRacer community uses: rows of centre, inner and outer x and y."""

from __future__ import annotations

import io
import math
import struct
import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from racer.store.tracks import LARGEST
from racer.tracks.arithmetic import Floats, norm
from racer.tracks.checks import RINGS, SHORTEST_STEP, WAYPOINTS, BadTrack, at, check_numbers, inside, left_of_line
from racer.tracks.race_track import Track
from shared_store.contract.error_text import counted
from shared_store.volume.files import DamagedFile, open_regular

_MAGIC = b"\x93NUMPY"
_CLOSED = 1e-3
"""Greatest distance of the last row from the first one [m]."""
_MISSING = 1.5
"""Ends of a line that are at most so many of its longest steps apart are those of a loop of which the closing row is missing."""
_EVEN = 1.01
"""Rows that are evenly apart differ by no more than this."""


@dataclass(frozen=True)
class Imported:
    """A track that was read, and what was mended on the way, a line for each thing."""

    track: Track
    notes: tuple[str, ...]


def to_bytes(track: Track) -> bytes:
    """A track as an ``.npy`` file (format 1.0, little-endian float64, (N + 1, 6)); the same bytes from every version of numpy."""
    rows = track.rows().astype("<f8")
    header = f"{{'descr': '<f8', 'fortran_order': False, 'shape': ({len(rows)}, {rows.shape[1]}), }}"
    start = len(_MAGIC) + 4
    header = header.ljust(-(-(start + len(header) + 1) // 64) * 64 - start - 1) + "\n"
    return _MAGIC + b"\x01\x00" + struct.pack("<H", len(header)) + header.encode() + rows.tobytes()


def read_file(path: Path, name: str) -> Imported:
    """The track in a file; no code in it is run.

    Args:
        path: An ``.npy`` file.
        name: Of the track.

    Raises:
        BadTrack: The file can't be read, or it is not a track.
    """
    try:
        with open_regular(path.resolve()) as file:
            data = file.read(LARGEST + 1)
    except DamagedFile:
        raise BadTrack(f"{path}: it is not a regular file; name an .npy file") from None
    except OSError as error:
        raise BadTrack(f"{path}: it can't be read ({error.strerror or error})") from None
    try:
        return from_bytes(data, name)
    except BadTrack as error:
        raise BadTrack(f"{path}: {error}") from None


def from_bytes(data: bytes, name: str) -> Imported:
    """The track in the bytes of an ``.npy`` file; as :func:`read_file`."""
    rows = _array(data)
    return _track(rows, name)


def _array(data: bytes) -> Floats:
    """The numbers of an ``.npy`` file, (rows, 6) float64. Raises BadTrack."""
    if len(data) > LARGEST:
        raise BadTrack(f"it has more than {LARGEST >> 20} MiB, which no track needs ({WAYPOINTS[1]} waypoints at most)")
    if data[:2] == b"PK":
        raise BadTrack("it is a zip archive (.npz?); save the one array with numpy.save")
    if data[:6] != _MAGIC:
        raise BadTrack("it is not an .npy file (numpy.save writes one)")
    stream = io.BytesIO(data)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # files that Python 2 wrote
            version = np.lib.format.read_magic(stream)
            read = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}[version]
            shape, columns_first, kind = read(stream)
    except Exception:  # the parser of headers fails in many ways
        raise BadTrack("the header of the .npy file is damaged; write it again with numpy.save") from None
    if kind.hasobject:
        raise BadTrack(
            "it holds pickled Python objects, which may run code and are not read; save an array of float64 with numpy.save"
        )
    if kind.kind != "f" or kind.itemsize not in (4, 8):
        raise BadTrack(f"it holds {kind}; expected float64")
    if len(shape) != 2 or shape[1] != 6:
        raise BadTrack(f"it has the shape {shape}; expected (N, 6): centre x, y, inner x, y, outer x, y")
    rest = data[stream.tell() :]
    if len(rest) != math.prod(shape) * kind.itemsize:
        raise BadTrack(
            f"it has {len(rest)} bytes of numbers where {math.prod(shape) * kind.itemsize} belong: cut short or damaged"
        )
    rows: Floats = np.frombuffer(rest, kind).reshape(shape, order="F" if columns_first else "C").astype(np.float64)
    return rows


def _track(rows: Floats, name: str) -> Imported:
    """Raises BadTrack."""
    if len(rows) < WAYPOINTS[0]:
        raise BadTrack(
            f"{counted(len(rows), 'row')} are too few; a track has {WAYPOINTS[0] + 1} or more, the last one is the first"
        )
    for column, ring in enumerate(RINGS):
        check_numbers(rows[:, 2 * column : 2 * column + 2], ring)
    closed, notes = _is_closed(rows)
    if closed:
        rows = rows[:-1]
    kept = _different(rows[:, :2], closed)
    if left_out := len(rows) - len(kept):
        notes.append(
            f"left out {counted(left_out, 'row')} whose waypoint stands there twice, the first one row {_first_missing(kept)}"
        )
        rows = rows[kept]
    center, inner, outer = rows[:, 0:2], rows[:, 2:4], rows[:, 4:6]
    if closed and not inside(center, inner).any() and inside(center, outer).all():
        inner, outer = outer, inner
        notes.append("the borders were swapped (columns 2 and 3 lie outside the centre line): taken the right way")
    if not closed and not left_of_line(center, inner).any() and left_of_line(center, outer).all():
        inner, outer = outer, inner
        notes.append("the borders were swapped (columns 2 and 3 lie right of the centre line): taken the right way")
    track = Track(name, center, inner, outer, closed)
    if track.slanted:
        notes.append(track.slant)
    return Imported(track, tuple(notes))


def _is_closed(rows: Floats) -> tuple[bool, list[str]]:
    """Whether the last row is the first one once more, with notes. Raises BadTrack for a loop of which rows are missing.

    The ends of an open track are farther from each other than its road is wide and its waypoints are apart. A border of a loop may be
    open by no more than its own rows are apart: many files have it so.
    """
    lines = [rows[:, 2 * column : 2 * column + 2] for column in range(3)]
    gaps = [float(norm(line[-1] - line[0])) for line in lines]
    longest = [float(norm(np.diff(line[:-1], axis=0)).max()) for line in lines]
    apart = [(name, line, gap) for name, line, gap in zip(RINGS, lines, gaps, strict=True) if gap > _CLOSED]
    if gaps[0] <= _CLOSED and all(gap <= max(_CLOSED, _EVEN * step) for gap, step in zip(gaps, longest, strict=True)):
        return True, [
            f"the {name} is open by {gap:.3f} m, no more than its rows are apart: taken as a loop without its last point"
            for name, _, gap in apart
        ]
    if min(gaps) > _CLOSED and gaps[0] > max(float(norm(lines[1][0] - lines[2][0])), _MISSING * longest[0]):
        return False, [f"taken as an open track; its ends are {gaps[0]:.2f} m apart"]
    name, line, gap = apart[0]
    raise BadTrack(
        f"the {name} is open: {gap:.3f} m lie between {at(line, 0)} and {at(line, len(rows) - 1)}; the last row of a loop has to be the "
        "first one once more, and the ends of an open track are farther apart than its road is wide and than its waypoints"
    )


def _different(center: Floats, closed: bool) -> NDArray[np.int64]:
    """Rows whose waypoint is not that of the kept row before, nor, at the end of a loop, that of the first."""
    kept = [0]
    for row in range(1, len(center)):
        if norm(center[row] - center[kept[-1]]) >= SHORTEST_STEP:
            kept.append(row)
    while closed and len(kept) > 1 and norm(center[kept[-1]] - center[0]) < SHORTEST_STEP:
        kept.pop()
    return np.array(kept)


def _first_missing(kept: NDArray[np.int64]) -> int:
    gaps = np.flatnonzero(kept != np.arange(len(kept)))
    return int(gaps[0]) if len(gaps) else len(kept)
