"""The place of a car on its track, by circles and ovals computed by hand; the car on the device, by the same."""

from __future__ import annotations

import math

import numpy as np
import pytest
import warp as wp

from racer.car.bicycle import CarMotion, drive
from racer.car.car_arrays import overlap
from racer.tracks import road
from racer.tracks.arithmetic import sine_cosine
from racer.tracks.circuit import GAP, bounds, side_by_side
from racer.tracks.generator import make_random
from racer.tracks.geometry import advance, on_road, place_at, project
from racer.tracks.presets import make_preset
from racer.tracks.race_track import CLOCKWISE, COUNTER_CLOCKWISE, Track
from tests.support.racer.racing import open_track


def square(side: float = 4.0, width: float = 1.0) -> Track:
    """A square with its start line at the origin: along the x axis, up, back and down, a waypoint every 0.5 m, counter-clockwise."""
    edge = np.arange(0, side, 0.5)
    none, whole = np.zeros_like(edge), np.full_like(edge, side)
    edges = (edge, none), (whole, edge), (side - edge, whole), (none, side - edge)
    center = np.vstack([np.stack(each, -1) for each in edges])
    middle = np.array([side / 2, side / 2])
    share = width / side
    return Track("square", center, middle + (center - middle) * (1 - share), middle + (center - middle) * (1 + share))


def test_sines_and_cosines_are_those_of_the_library() -> None:
    angles = np.linspace(-20, 20, 4001)
    sine, cosine = sine_cosine(angles)
    assert np.abs(sine - np.sin(angles)).max() < 1e-14 and np.abs(cosine - np.cos(angles)).max() < 1e-14


def test_sines_are_made_of_nothing_but_operations_that_are_rounded_alike_everywhere() -> None:
    def plain(angle: float) -> float:
        rest = angle - 2 * math.pi * round(angle / (2 * math.pi))
        sine = 1.0
        for term in range(15, 0, -1):
            sine = 1 - rest * rest / (2 * term * (2 * term + 1)) * sine
        return rest * sine

    angles = np.linspace(-9, 9, 2001)
    assert sine_cosine(angles)[0].tolist() == [plain(angle) for angle in angles.tolist()]


def test_the_measures_of_a_square_are_those_of_its_sides() -> None:
    track = square()
    assert (track.length, track.direction, len(track.center)) == (16.0, COUNTER_CLOCKWISE, 32)
    # at a corner from the inner one to a side: the borders' nearest points, as in AWS's simulator
    assert track.width.min() == 1.0 and track.width.max() == pytest.approx(math.hypot(0.5, 1.0))
    assert list(track.along[:4]) == [0.0, 0.5, 1.0, 1.5]
    assert track.rows().shape == (33, 6) and (track.rows()[0] == track.rows()[-1]).all()


def test_a_point_is_projected_onto_the_centre_line_and_the_width_between_waypoints_changes_evenly() -> None:
    found = project(square(), [[1.2, 0.3], [4.25, 2.6], [3.0, 3.8], [-0.1, 1.0]])
    np.testing.assert_allclose(found.point, [[1.2, 0], [4, 2.6], [3, 4], [0, 1]])
    np.testing.assert_allclose(found.distance, [0.3, 0.25, 0.2, 0.1])
    assert list(found.left) == [True, False, True, False]  # the inside is on the left
    np.testing.assert_allclose(found.along, [1.2, 6.6, 9.0, 15.0])
    np.testing.assert_allclose(found.progress, np.array([1.2, 6.6, 9.0, 15.0]) / 16 * 100)
    np.testing.assert_allclose(found.heading, [0, math.pi / 2, math.pi, -math.pi / 2])
    assert list(found.before) == [2, 13, 18, 30] and list(found.after) == [3, 14, 19, 31]
    # from the corner to the next waypoint, beside the corner of the inner border
    found = project(square(), [[0.125, 0.0], [2.0, 0.3]])
    corner = math.hypot(0.5, 1.0)
    np.testing.assert_allclose(found.width, [corner + 0.25 * (1.0 - corner), 1.0])
    found = project(square(), [[4.3, -0.4]])
    np.testing.assert_allclose(found.point, [[4, 0]], err_msg="the corner is the nearest point for a car outside it")
    assert found.distance[0] == pytest.approx(0.5) and not found.left[0]
    assert (found.before[0], found.after[0], found.along[0]) == (8, 9, 4.0)


def test_a_waypoint_that_the_car_has_reached_counts_as_the_one_behind() -> None:
    track = square()
    forth, back = project(track, track.center), project(track, track.center, backwards=True)
    rows = np.arange(32)
    assert (forth.before == rows).all() and (forth.after == rows + 1).all()
    assert (back.before == -rows % 32).all() and (back.after == back.before + 1).all()
    assert forth.along[0] == 0.0 and back.along[0] == 0.0
    assert not forth.left.any() and not back.left.any(), "on the line is not to the left of it"


@pytest.mark.parametrize("direction", [COUNTER_CLOCKWISE, CLOCKWISE])
def test_a_track_that_is_turned_round_is_the_track_driven_backwards(direction: str) -> None:
    track = make_preset("chicane", direction=direction)
    turned = track.turned_round()
    assert {track.direction, turned.direction} == {COUNTER_CLOCKWISE, CLOCKWISE}
    draws = np.random.default_rng(3)
    points = draws.uniform(-9, 9, (500, 2)) * [1, 0.4]
    present, here = project(track, points, backwards=True), project(turned, points)
    np.testing.assert_allclose(here.point, present.point, atol=1e-12)
    np.testing.assert_allclose(here.along, present.along, atol=1e-9)
    np.testing.assert_array_equal(here.left, present.left)
    np.testing.assert_array_equal(here.before, present.before)
    np.testing.assert_allclose(np.cos(here.heading - present.heading), 1)


def test_progress_round_a_circle_is_the_angle() -> None:
    angles = 2 * math.pi * np.arange(200) / 200
    ring = np.stack((np.cos(angles), np.sin(angles)), -1)
    track = Track("circle", 5 * ring, 4.5 * ring, 5.5 * ring)
    assert track.length == pytest.approx(200 * 2 * 5 * math.sin(math.pi / 200), rel=1e-12)
    assert track.least_radius == pytest.approx(5.0, rel=1e-9)
    found = project(track, 5.2 * ring[[0, 50, 100, 150]])
    np.testing.assert_allclose(found.progress, [0, 25, 50, 75], atol=1e-9)
    np.testing.assert_allclose(found.distance, 0.2)
    assert not found.left.any()
    assert project(track, [[0.1, 4.6]]).left[0]


def test_the_road_lies_between_the_borders() -> None:
    assert list(
        on_road(square(), [[2, 0], [2, 0.49], [2, 0.51], [2, -0.49], [2, -0.51], [2, 2], [4.4, 4.4], [9, 2]])
    ) == [*(True, True, False, True, False, False, True, False)]


def test_a_place_along_the_track_projects_to_itself_in_both_directions() -> None:
    track = make_preset("rounded-rectangle")
    along = np.array([0.0, 0.01, 3.3, 12.7, track.length - 0.01])
    for backwards in (False, True):
        points, headings = place_at(track, along, backwards)
        found = project(track, points, backwards)
        np.testing.assert_allclose(found.along, along, atol=1e-9)
        np.testing.assert_allclose(np.cos(found.heading - headings), 1)
        np.testing.assert_allclose(place_at(track, [-1e-20], backwards)[0], track.center[:1], atol=1e-12)
    behind, _ = place_at(track, [-1.0])
    np.testing.assert_allclose(behind, place_at(track, [track.length - 1.0])[0])


TRACKS = [make_preset("oval"), make_random(3), make_preset("chicane", direction=CLOCKWISE, width=1.3), open_track()]


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
def _drive(starts: wp.array[CarMotion], request: wp.array[wp.vec2], lags: wp.vec2, ends: wp.array[CarMotion]):
    car = wp.tid()
    motion = starts[car]
    for _ in range(15):
        motion = drive(motion, request[car][0], request[car][1], 0.0, lags[0], lags[1], 1.0 / 15.0, 4)
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
    request = np.array([[4.0, 0.5236], [1.0, -0.3], [0.5, 0.1], [2.0, -0.5236]])
    starts = np.array([[0, 0, 0, 0, 0], [1, 2, -1, 3, 0.4], [0.3, -1, 2, 0.1, 0], [0, 0, 3, 4, 0.5]], float)
    lags = (0.2, 0.05)
    rows = np.array([tuple(row) for row in starts], dtype=CarMotion.numpy_dtype())
    motions = wp.array(rows, dtype=CarMotion)
    ends = wp.zeros(4, dtype=CarMotion)
    wp.launch(_drive, dim=4, inputs=[motions, wp.array(request, dtype=wp.vec2), wp.vec2(*lags)], outputs=[ends])
    for start, (speed, steering), end in zip(starts, request, ends.numpy(), strict=True):
        expected = by_hand(start, speed, steering, lags, 1.0)
        np.testing.assert_allclose(list(end), expected, atol=1e-4)


def test_without_lag_the_car_drives_the_circle_of_its_steering_at_once() -> None:
    motions, ends = wp.zeros(1, dtype=CarMotion), wp.zeros(1, dtype=CarMotion)
    request = wp.array([[1.0, 0.4]], dtype=wp.vec2)
    wp.launch(_drive, dim=1, inputs=[motions, request, wp.vec2(0.0, 0.0)], outputs=[ends])
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
