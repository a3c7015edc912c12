"""The car on the device, against a bicycle that is integrated by hand and against the tracks' own geometry."""

from __future__ import annotations

import math

import numpy as np
import pytest
import warp as wp

from worker.racer import road
from worker.racer.bicycle import Motion, drive
from worker.racer.car_arrays import overlap
from worker.racer.circuit import GAP, bounds, side_by_side
from worker.racer.generator import make_random
from worker.racer.geometry import advance, on_road, place_at, project
from worker.racer.presets import make_preset
from worker.racer.track import CLOCKWISE

TRACKS = [make_preset("oval"), make_random(3), make_preset("chicane", direction=CLOCKWISE, width=1.3)]


@wp.struct
class Found:
    place: road.Place
    on_road: bool
    same: bool


@wp.kernel
def _find(
    roads: road.RoadArrays,
    tracks: wp.array[wp.int32],
    points: wp.array[wp.vec2],
    backwards: wp.array[wp.bool],
    begins: wp.array[wp.int32],
    found: wp.array[Found],
):
    point = wp.tid()
    track = tracks[point]
    window = roads.window[track]
    result = Found()
    result.place = road.project(roads, track, points[point], backwards[point], 0, roads.count[track])
    near = road.project(roads, track, points[point], backwards[point], begins[point] - window, 2 * window + 1)
    result.same = near.row == result.place.row
    result.on_road = road.on_road(roads, track, points[point])
    found[point] = result


@wp.kernel
def _place(
    roads: road.RoadArrays,
    tracks: wp.array[wp.int32],
    along: wp.array[wp.float32],
    other: wp.array[wp.float32],
    backwards: wp.array[wp.bool],
    places: wp.array[wp.vec3],
    moved: wp.array[wp.float32],
):
    point = wp.tid()
    places[point] = road.place_at(roads, tracks[point], along[point], backwards[point])
    moved[point] = road.advance(roads, tracks[point], along[point], other[point])


@wp.kernel
def _drive(starts: wp.array[Motion], asked: wp.array[wp.vec2], lags: wp.vec2, ends: wp.array[Motion]):
    car = wp.tid()
    motion = starts[car]
    for _ in range(15):
        motion = drive(motion, asked[car][0], asked[car][1], 0.0, lags[0], lags[1], 1.0 / 15.0, 4)
    ends[car] = motion


@wp.kernel
def _overlap(first: wp.array[wp.vec3], second: wp.array[wp.vec3], found: wp.array[wp.bool]):
    pair = wp.tid()
    found[pair] = overlap(first[pair], wp.vec2(0.14, 0.1), second[pair], wp.vec2(0.2, 0.12))


def arrays() -> road.RoadArrays:
    return road.road_arrays(TRACKS, np.zeros((len(TRACKS), 2)), "cpu")


def turned(angle: np.ndarray) -> np.ndarray:
    return np.abs((angle + math.pi) % (2 * math.pi) - math.pi)


def test_projected_points_agree_with_the_tracks_geometry() -> None:
    random = np.random.default_rng(5)
    count = 600
    which = random.integers(0, len(TRACKS), count)
    backwards = random.random(count) < 0.5
    points = np.zeros((count, 2))
    for number, track in enumerate(TRACKS):
        mine = which == number
        places, _ = place_at(track, random.random(mine.sum()) * track.length)
        points[mine] = places + random.uniform(-1.2, 1.2, (mine.sum(), 2))
    begins = np.zeros(count, int)
    for number, track in enumerate(TRACKS):
        mine = which == number
        begins[mine] = project(track, points[mine]).before
    found = wp.zeros(count, dtype=Found)
    inputs = [wp.array(which, dtype=wp.int32), wp.array(points.astype(np.float32), dtype=wp.vec2)]
    inputs += [wp.array(backwards, dtype=wp.bool), wp.array(begins, dtype=wp.int32)]
    wp.launch(_find, dim=count, inputs=[arrays(), *inputs], outputs=[found])
    rows = found.numpy()
    assert rows["same"].all()  # from a row nearby as from everywhere
    for number, track in enumerate(TRACKS):
        mine = which == number
        place, expected = rows["place"][mine], project(track, points[mine], backwards[mine])
        for name in ("before", "after", "left"):
            assert (place[name] == getattr(expected, name)).all(), name
        for name in ("point", "distance", "along", "width"):
            np.testing.assert_allclose(place[name], getattr(expected, name), atol=1e-4, err_msg=name)
        assert turned(place["heading"] - expected.heading).max() < 1e-4
        assert (rows["on_road"][mine] == on_road(track, points[mine])).all()
    assert 0.2 < rows["on_road"].mean() < 0.95  # both kinds were there


def test_places_and_distances_agree_with_the_tracks_geometry() -> None:
    random = np.random.default_rng(6)
    count = 300
    which = random.integers(0, len(TRACKS), count)
    backwards = random.random(count) < 0.5
    along = random.uniform(-50, 90, count)
    along[:6] = 0.0  # the start line, from both sides
    other = along + random.uniform(-3, 3, count)
    places, moved = wp.zeros(count, dtype=wp.vec3), wp.zeros(count, dtype=wp.float32)
    inputs = [wp.array(which, dtype=wp.int32), *(wp.array(each, dtype=wp.float32) for each in (along, other))]
    inputs = [arrays(), *inputs, wp.array(backwards, dtype=wp.bool)]
    wp.launch(_place, dim=count, inputs=inputs, outputs=[places, moved])
    for number, track in enumerate(TRACKS):
        mine = which == number
        points, headings = place_at(track, along[mine], backwards[mine])
        np.testing.assert_allclose(places.numpy()[mine, :2], points, atol=1e-4)
        assert np.median(turned(places.numpy()[mine, 2] - headings)) < 1e-4
        np.testing.assert_allclose(moved.numpy()[mine], advance(track, along[mine], other[mine]), atol=1e-4)


def test_the_search_window_covers_its_reach_and_no_more() -> None:
    for track in TRACKS:
        window = road.window_of(track)
        lengths = [np.roll(track.steps, -row)[:window].sum() for row in range(len(track.steps))]
        assert (
            min(lengths)
            >= road.REACH
            > min(sum(np.roll(track.steps, -row)[: window - 1]) for row in range(len(lengths)))
        )


def by_hand(state: np.ndarray, speed: float, steering: float, lags: tuple[float, float], seconds: float) -> np.ndarray:
    """A bicycle, from its rear axle, in steps of 0.1 ms: x, y, heading, speed, steering."""
    x, y, heading, v, delta = state
    step = 1e-4
    for _ in range(round(seconds / step)):
        # the state in the middle of the step
        middle_v = speed + (v - speed) * math.exp(-0.5 * step / lags[0])
        middle_delta = steering + (delta - steering) * math.exp(-0.5 * step / lags[1])
        rate = middle_v * math.tan(middle_delta) / 0.164
        middle = heading + 0.5 * step * rate
        x, y = x + step * middle_v * math.cos(middle), y + step * middle_v * math.sin(middle)
        heading += step * rate
        v = speed + (v - speed) * math.exp(-step / lags[0])
        delta = steering + (delta - steering) * math.exp(-step / lags[1])
    return np.array([x, y, heading, v, delta])


def test_the_car_moves_as_a_bicycle_that_is_integrated_by_hand() -> None:
    asked = np.array([[4.0, 0.5236], [1.0, -0.3], [0.5, 0.1], [2.0, -0.5236]])
    starts = np.array([[0, 0, 0, 0, 0], [1, 2, -1, 3, 0.4], [0.3, -1, 2, 0.1, 0], [0, 0, 3, 4, 0.5]], float)
    lags = (0.2, 0.05)
    rows = np.array([tuple(row) for row in starts], dtype=Motion.numpy_dtype())
    motions = wp.array(rows, dtype=Motion)
    ends = wp.zeros(4, dtype=Motion)
    wp.launch(_drive, dim=4, inputs=[motions, wp.array(asked, dtype=wp.vec2), wp.vec2(*lags)], outputs=[ends])
    for start, (speed, steering), end in zip(starts, asked, ends.numpy(), strict=True):
        expected = by_hand(start, speed, steering, lags, 1.0)
        np.testing.assert_allclose(list(end), expected, atol=1e-4)


def test_without_lag_the_car_drives_the_circle_of_its_steering_at_once() -> None:
    motions, ends = wp.zeros(1, dtype=Motion), wp.zeros(1, dtype=Motion)
    asked = wp.array([[1.0, 0.4]], dtype=wp.vec2)
    wp.launch(_drive, dim=1, inputs=[motions, asked, wp.vec2(0.0, 0.0)], outputs=[ends])
    x, y, heading, *_ = ends.numpy()[0]
    radius = 0.164 / math.tan(0.4)
    assert heading == pytest.approx(1.0 / radius, abs=1e-4)
    assert (x, y) == pytest.approx((radius * math.sin(heading), radius * (1 - math.cos(heading))), abs=1e-4)


def test_rectangles_touch_exactly_where_they_overlap() -> None:
    first = np.array([[0, 0, 0], [0, 0, 0], [0, 0, 0], [0, 0, math.pi / 4], [0, 0, 0]], np.float32)
    # beside it by a hair; a hair too far; corner to corner, turned; a turned corner that reaches; far
    second = np.array([[0.339, 0, 0], [0.341, 0, 0], [0.33, 0.24, 0], [0.3, 0, 0], [3, 0, 1]], np.float32)
    found = wp.zeros(5, dtype=wp.bool)
    inputs = [wp.array(each, dtype=wp.vec3) for each in (first, second)]
    wp.launch(_overlap, dim=5, inputs=inputs, outputs=[found])
    assert list(found.numpy()) == [True, False, False, True, False]


def test_tracks_lie_side_by_side_and_far_apart() -> None:
    corners = side_by_side(TRACKS)
    boxes = [[end + corner for end in bounds(track)] for track, corner in zip(TRACKS, corners, strict=True)]
    for number, (low, high) in enumerate(boxes):
        for other_low, other_high in boxes[number + 1 :]:
            assert max(*(other_low - high), *(low - other_high)) >= GAP - 1e-9
    assert (side_by_side(TRACKS[:1]) == 0).all()
