"""Tracks that are made or read: measures by hand, the same bytes everywhere, and what is refused as one."""

from __future__ import annotations

import hashlib
import io
import math
import os
import pickle
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from racer.store.tracks import LARGEST
from racer.tracks.checks import BadTrack, area_of, inside
from racer.tracks.generator import make_random
from racer.tracks.geometry import on_road
from racer.tracks.naming import keep, resolve
from racer.tracks.presets import PRESETS, make_preset
from racer.tracks.race_track import CLOCKWISE, COUNTER_CLOCKWISE, Track
from racer.tracks.route_file import from_bytes, read_file, to_bytes
from shared_store.volume.layout import Store
from tests.support.refusals import refusal


def ring(radius: float, count: int = 100) -> np.ndarray:
    """Points of a circle about the origin, counter-clockwise."""
    angles = 2 * math.pi * np.arange(count) / count
    return radius * np.stack((np.cos(angles), np.sin(angles)), -1)


def parts(center: float = 3.0) -> dict[str, np.ndarray]:
    """A circular track."""
    return {"center": ring(center), "inner": ring(center - 0.5), "outer": ring(center + 0.5)}


@pytest.mark.parametrize(
    ("preset", "length", "units"),
    [
        ("oval", 30.0, 2 * math.pi + 4),
        ("rounded-rectangle", 40.0, 2 * math.pi + 14),
        ("chicane", 60.0, 23 * math.pi / 3 + 10),
    ],
)
def test_a_preset_has_the_length_and_the_radius_that_its_arcs_and_straights_have(
    preset: str, length: float, units: float
) -> None:
    track = make_preset(preset, length=length, width=1.2, spacing=0.1)
    radius = length / units
    # a chord of 0.1 m is shorter than its arc by 0.1³ / 24 r², in at most all of the segments
    assert length - length * 0.1**2 / (24 * radius**2) - 1e-3 <= track.length <= length
    assert track.least_radius == pytest.approx(radius, rel=1e-6)
    np.testing.assert_allclose(track.width, 1.2)
    assert len(track.center) == round(length / 0.1) and track.direction == COUNTER_CLOCKWISE
    np.testing.assert_allclose(track.center.mean(axis=0), 0, atol=0.01)


def test_the_points_of_an_oval_lie_on_its_straights_and_half_circles() -> None:
    track = make_preset("oval", length=(2 * math.pi + 4) * 2, width=1.0)
    radius = 2.0  # straights of 4 m, from x = -2 to 2
    x, y = track.center.T
    np.testing.assert_allclose(track.center[0], [0, -2], atol=1e-12)
    straight = np.abs(x) <= 2
    np.testing.assert_allclose(np.abs(y[straight]), radius, atol=1e-12)
    np.testing.assert_allclose(np.hypot(np.abs(x[~straight]) - 2, y[~straight]), radius, atol=1e-12)
    np.testing.assert_allclose(track.inner[0], [0, -1.5], atol=1e-12)
    np.testing.assert_allclose(track.outer[0], [0, -2.5], atol=1e-12)


def test_fifty_seeds_make_fifty_tracks() -> None:
    digests = set()
    for seed in range(50):
        track = make_random(seed)
        digests.add(track.digest)
        assert track.length == pytest.approx(30.0, rel=1e-12) and len(track.center) == 200
        assert track.steps.std() < 0.01 * track.steps.mean(), "the waypoints are evenly spaced"
        assert track.least_radius >= 0.75
        np.testing.assert_allclose(track.width, 1.0, rtol=1e-12)
        assert on_road(track, track.center).all()
        assert inside(track.outer, track.inner).all() and not inside(track.inner, track.outer).any()
        assert 0 < area_of(track.inner) < area_of(track.center) < area_of(track.outer)
    assert len(digests) == 50


def test_a_seed_means_the_same_bytes_for_ever() -> None:
    assert to_bytes(make_random(7)) == to_bytes(make_random(7))
    digest = hashlib.sha256(to_bytes(make_random(7))).hexdigest()
    assert digest == "c1ec17bb48cd2b2c052b00c6ecadade90bd83e027650e5affe5e8d4b3661faf0", (
        "every job that names random:7 would get another track"
    )
    assert make_preset("chicane").digest == "9cc12ee1408c11ec774e63f705727f224aaec5b525cb8bc758478b7dcbaac5f3"


def test_a_drawn_track_has_the_requested_measures() -> None:
    track = make_random(3, length=60.0, width=0.8, spacing=0.2, roughness=1.0, least_radius=1.5, direction=CLOCKWISE)
    assert track.length == pytest.approx(60.0) and len(track.center) == 300
    assert track.least_radius >= 1.5 and track.direction == CLOCKWISE
    np.testing.assert_allclose(track.width, 0.8)
    circle = make_random(3, roughness=0.0)
    assert circle.least_radius == pytest.approx(30 / (2 * math.pi), rel=1e-3)


@pytest.mark.parametrize(
    ("measures", "words"),
    [
        ({"length": 3.0}, "length 3 m: expected 4 to 1000 m"),
        ({"length": math.nan}, "length nan m: expected 4"),
        ({"width": 0.1}, "width 0.1 m: expected 0.3 to 5 m"),
        ({"spacing": 0.7}, "spacing 0.7 m: expected 0.02 to 0.5 m"),
        ({"length": 400.0, "spacing": 0.05}, "that makes 8000 of them, expected 20 to 5000; change the spacing"),
        ({"direction": "clockwize"}, "direction clockwize: did you mean clockwise?"),
        ({"roughness": 2.0}, "roughness 2: expected 0 to 1"),
        ({"width": 1.6}, "a radius of 0.75 m, too little for a road of 1.6 m"),
        ({"length": 8.0, "least_radius": 2.0}, "a radius of 2 m is not possible on 8 m"),
        ({"length": 8.0, "roughness": 1.0}, "seed 1: none of 200 curves fits"),
    ],
)
def test_a_track_that_cannot_be_drawn_is_refused_in_one_line(measures: dict[str, object], words: str) -> None:
    assert words in refusal(make_random, 1, error=BadTrack, **measures)


def test_a_preset_that_is_too_short_for_its_width_says_how_wide_it_may_be() -> None:
    with pytest.raises(
        BadTrack, match=r"oval of 8 m: .* radius of 0.78 m, too little for a road of 1.5 m; .* at most 1.35 m wide"
    ):
        make_preset("oval", length=8.0, width=1.5)
    assert make_preset("oval", length=8.0, width=1.35).name == "oval"
    with pytest.raises(BadTrack, match=r"preset ovel: there is no such preset; did you mean oval\?"):
        make_preset("ovel")


def bowtie() -> dict[str, np.ndarray]:
    """A figure eight whose centre line meets itself exactly at a waypoint."""
    t = 2 * math.pi * np.arange(80) / 80
    center = np.stack((5 * np.cos(t), 5 * np.sin(t) * np.cos(t)), -1)
    return {"center": center, "inner": center - 0.3, "outer": center + 0.3}


def bumpy() -> dict[str, np.ndarray]:
    """A circle with one waypoint 0.2 m outside of it: with its neighbours, 0.2 m away, it makes a curve of 0.2 m."""
    rings = {"center": ring(3.0, 92), "inner": ring(2.5, 92), "outer": ring(3.5, 92)}
    rings["center"][0] = 3.2, 0.0
    return rings


def changed(name: str, row: int, x: float, y: float) -> dict[str, np.ndarray]:
    track = parts()
    track[name][row] = x, y
    return track


@pytest.mark.parametrize(
    ("rings", "words"),
    [
        ({name: points[::10] for name, points in parts().items()}, "10 different waypoints are too few"),
        (changed("inner", 7, math.nan, 0.0), "inner border: row 7 (x nan, y 0.000) is not finite"),
        (changed("outer", 3, 2e7, 0.0), "outer border: row 3 (x 20000000.000, y 0.000) is farther than 10000 m"),
        (changed("center", 5, 9.0, 9.0), "the centre line has a gap of"),
        (changed("center", 5, *parts()["center"][4]), "the waypoint of row 4"),
        ({**parts(), "inner": ring(2.9), "outer": ring(3.1)}, "the road is 0.200 m wide at row"),
        (changed("outer", 9, *parts()["inner"][9]), "the centre line and the outer border cross or touch: row 8"),
        ({**parts(), "outer": ring(9.0)}, "the road is 6.500 m wide at row"),
        (bumpy(), "the curve at row 0 (x 3.200, y 0.000) has a radius of 0.20 m, which no car can drive"),
        (bowtie(), "the centre line crosses or touches itself: row"),
        (changed("inner", 20, 1.1, 2.9), "the centre line and the inner border cross or touch: row"),
        (changed("outer", 50, *parts()["outer"][53]), "the outer border crosses or touches itself: row"),
        ({**parts(), "inner": ring(3.5), "outer": ring(2.5)}, "the inner border lies outside the centre line: row 0 (x 3.500, y 0.000) (the borders seem"),
        ({**parts(), "outer": ring(2.1)}, "the outer border does not enclose the centre line: row 0"),
    ],
)  # fmt: skip
def test_rings_other_than_a_track_are_refused_with_row_and_place(rings: dict[str, np.ndarray], words: str) -> None:
    assert words in refusal(Track, "bad", **rings, error=BadTrack)


def test_a_hairpin_may_turn_about_one_point_of_its_inner_border() -> None:
    rings = parts()
    rings["inner"][10:14] = rings["inner"][12]
    assert Track("hairpin", **rings).length > 18


def test_every_preset_can_be_driven_both_ways() -> None:
    for preset in PRESETS:
        present, back = make_preset(preset), make_preset(preset, direction=CLOCKWISE)
        assert (present.direction, back.direction) == (COUNTER_CLOCKWISE, CLOCKWISE)
        np.testing.assert_array_equal(present.center[0], back.center[0])
        np.testing.assert_array_equal(present.inner[1:], back.inner[:0:-1])


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return Store(tmp_path / "store").open()


def test_a_name_means_a_preset_a_seed_or_a_track_of_the_store(store: Store) -> None:
    kept = make_random(5, "hills", length=40.0)
    keep(store, kept, {"seed": 5})
    assert resolve("oval", None).digest == make_preset("oval").digest
    assert resolve("random:7", None).digest == make_random(7).digest
    found = resolve("hills", store)
    assert (found.name, found.digest) == ("hills", kept.digest)
    with pytest.raises(BadTrack, match="track oval: a preset is called so; choose another name"):
        keep(store, make_random(1, "oval"), {})


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("ovall", "track 'ovall': there is no such track; did you mean oval?"),
        ("hils", "did you mean hills?"),
        ("random", "did you mean random:7?"),
        ("random:x", "after random: stands an integer from 0 to 9223372036854775807, such as random:7"),
        ("random:-1", "after random: stands an integer"),
        (f"random:{2**63}", "after random: stands an integer"),
        ("random:" + "9" * 9999, "after random: stands an integer"),
        ("../hills", "there is no such track"),
        ("q\nq", "track 'q\\nq': there is no such track; available: oval, rounded-rectangle, chicane, hills, random:7"),
    ],
)
def test_a_name_that_means_nothing_is_refused_with_the_nearest_one(store: Store, name: str, words: str) -> None:
    keep(store, make_preset("oval", "hills"), {})
    assert words in refusal(resolve, name, store, error=BadTrack)


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
    output = "the borders were swapped (columns 2 and 3 lie outside the centre line): taken the right way"
    assert found.notes == (output,)


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
    message = refusal(read_file, path, "track", error=BadTrack)
    assert message.startswith(f"{path}: ") and words in message


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
