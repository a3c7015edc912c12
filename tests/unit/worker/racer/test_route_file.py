"""Files of the community's format: what is read, what is mended, and what is refused in one line."""

from __future__ import annotations

import io
import os
import pickle
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shared_store.tracks import LARGEST
from tests.support.refusals import refusal
from worker.racer.checks import BadTrack
from worker.racer.generator import make_random
from worker.racer.presets import make_preset
from worker.racer.route_file import from_bytes, read_file, to_bytes

OVAL = make_preset("oval")


def saved(rows: object, **options: bool) -> bytes:
    """The bytes that numpy.save writes."""
    stream = io.BytesIO()
    np.save(stream, np.asarray(rows) if not isinstance(rows, np.ndarray) else rows, **options)
    return stream.getvalue()


def test_a_track_comes_back_from_its_file_bit_for_bit() -> None:
    for track in (OVAL, make_random(4), make_preset("chicane", direction="clockwise")):
        data = to_bytes(track)
        found = from_bytes(data, "again")
        assert found.track.digest == track.digest and found.notes == ()
        assert (found.track.direction, found.track.length) == (track.direction, track.length)
        np.testing.assert_array_equal(np.load(io.BytesIO(data), allow_pickle=False), track.rows())


@pytest.mark.parametrize(
    "rows",
    [OVAL.rows(), np.asfortranarray(OVAL.rows()), OVAL.rows().astype(">f8"), OVAL.rows().astype("<f4")],
    ids=["float64", "columns-first", "big-endian", "float32"],
)
def test_any_array_of_real_numbers_is_read(rows: np.ndarray) -> None:
    np.testing.assert_allclose(from_bytes(saved(rows), "oval").track.center, OVAL.center, atol=1e-6)


def test_a_repeated_waypoint_is_left_out_and_reported() -> None:
    rows = OVAL.rows()
    twice = np.vstack((rows[:41], rows[40:41], rows[40:41], rows[41:], rows[-1:]))
    found = from_bytes(saved(twice), "oval")
    assert found.track.digest == OVAL.digest
    assert found.notes == ("left out 3 rows whose waypoint stands there twice, the first one row 41",)


@pytest.mark.parametrize("direction", ["clockwise", "counter-clockwise"])
def test_swapped_borders_are_taken_the_right_way_whatever_the_direction(direction: str) -> None:
    track = make_preset("oval", direction=direction)
    found = from_bytes(saved(track.rows()[:, [0, 1, 4, 5, 2, 3]]), "oval")
    assert found.track.digest == track.digest
    said = "the borders were swapped (columns 2 and 3 lie outside the centre line): taken the right way"
    assert found.notes == (said,)


def test_borders_that_are_swapped_only_here_and_there_are_refused() -> None:
    rows = OVAL.rows()
    rows[30:60] = rows[30:60][:, [0, 1, 4, 5, 2, 3]]
    with pytest.raises(BadTrack, match="the centre line and the inner border cross or touch: row 29"):
        from_bytes(saved(rows), "oval")


def spoilt(row: int, column: int, value: float) -> bytes:
    rows = OVAL.rows()
    rows[row, column] = value
    return saved(rows)


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"", "it is not an .npy file"),
        (b"x,y\n1,2\n", "it is not an .npy file"),
        (pickle.dumps({"a": 1}), "it is not an .npy file"),
        (b"PK\x03\x04", "it is a zip archive"),
        (b"\x93NUMPY\x01\x00\xff\xff{", "the header of the .npy file is damaged"),
        (b"\x93NUMPY\x07\x00\x10\x00{", "the header of the .npy file is damaged"),
        (saved(np.array([OVAL.rows(), None], object), allow_pickle=True), "pickled Python objects, which may run code"),
        (saved(OVAL.rows().astype(int)), "it holds int64; expected float64"),
        (saved(OVAL.rows().astype(complex)), "it holds complex128; expected float64"),
        (saved(OVAL.rows()[:, :2]), "it has the shape (134, 2); expected (N, 6)"),
        (saved(OVAL.rows().ravel()), "it has the shape (804,); expected (N, 6)"),
        (to_bytes(OVAL)[:-8], "it has 6424 bytes of numbers where 6432 belong"),
        (to_bytes(OVAL).replace(b"(134, 6), }" + b" " * 11, b"(99999999999134, 6), }"), "it has 6432 bytes of numbers where 47999"),
        (bytes(LARGEST + 1), "it has more than 1 MiB"),
        (spoilt(17, 3, np.nan), "inner border: row 17"),
        (spoilt(17, 4, np.inf), "outer border: row 17"),
        (saved(OVAL.rows()[:-3]), "the centre line is open: 0.451 m lie between row 0"),
        (spoilt(-1, 4, 0.4), "the outer border is open: 0.400 m lie between row 0"),
        (saved(OVAL.rows()[:5]), "5 rows are too few"),
        (saved(np.repeat(OVAL.rows()[:1], 50, axis=0)), "1 different waypoints are too few"),
        (saved(OVAL.rows() * 1e6), "is farther than 10000 m from the origin"),
    ],
)  # fmt: skip
def test_a_file_other_than_a_track_is_refused_in_one_line(tmp_path: Path, data: bytes, words: str) -> None:
    path = tmp_path / "track.npy"
    path.write_bytes(data)
    told = refusal(read_file, path, "track", error=BadTrack)
    assert told.startswith(f"{path}: ") and words in told


def test_an_irregular_file_is_refused(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.npy")
    (tmp_path / "folder.npy").mkdir()
    for name in ("pipe.npy", "folder.npy"):
        with pytest.raises(BadTrack, match="it is not a regular file"):
            read_file(tmp_path / name, "track")
    with pytest.raises(BadTrack, match=r"it can't be read \(No such file or directory\)"):
        read_file(tmp_path / "none.npy", "track")


@settings(max_examples=150, deadline=None)
@given(place=st.integers(0, 200), value=st.binary(min_size=1, max_size=4))
def test_damaged_bytes_give_a_track_or_one_line(place: int, value: bytes) -> None:
    data = to_bytes(OVAL)
    try:
        from_bytes(data[:place] + value + data[place + len(value) :], "track")
    except BadTrack as error:
        assert "\n" not in str(error)
