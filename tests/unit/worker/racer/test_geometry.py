"""The place of a car on its track, compared with circles and ovals computed by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from worker.racer.arithmetic import sine_cosine
from worker.racer.geometry import advance, degrees, on_road, place_at, project
from worker.racer.presets import make_preset
from worker.racer.track import CLOCKWISE, COUNTER_CLOCKWISE, Track


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
    assert track.width.min() == 1.0 and track.width.max() == pytest.approx(math.sqrt(2))  # the diagonal at a corner
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
    np.testing.assert_allclose(degrees(found.heading), [0, 90, 180, -90])
    assert list(found.before) == [2, 13, 18, 30] and list(found.after) == [3, 14, 19, 31]
    # from the corner, where the road is √2 wide, to the next waypoint: 2.5 from the middle, its borders are half as far apart
    found = project(square(), [[0.125, 0.0], [2.0, 0.3]])
    np.testing.assert_allclose(found.width, [math.sqrt(2) + 0.25 * (1.25 - math.sqrt(2)), 1.0])
    found = project(square(), [[4.3, -0.4]])
    np.testing.assert_allclose(found.point, [[4, 0]], err_msg="the corner is the nearest point for a car outside it")
    assert found.distance[0] == pytest.approx(0.5) and not found.left[0]
    assert (found.before[0], found.after[0], found.along[0]) == (8, 9, 4.0)


def test_driving_backwards_reverses_left_progress_and_waypoints() -> None:
    found = project(square(), [[1.2, 0.3], [4.25, 2.6]], backwards=True)
    assert list(found.left) == [False, True]
    np.testing.assert_allclose(found.along, [14.8, 9.4])
    np.testing.assert_allclose(np.abs(found.heading), [math.pi, math.pi / 2])
    assert found.heading[1] < 0
    assert list(found.before) == [3, 14] and list(found.after) == [2, 13]
    mixed = project(square(), [[1.2, 0.3], [1.2, 0.3]], backwards=[False, True])
    assert list(mixed.left) == [True, False] and list(mixed.before) == [2, 3]


def test_a_waypoint_that_the_car_has_reached_counts_as_the_one_behind() -> None:
    track = square()
    forth, back = project(track, track.center), project(track, track.center, backwards=True)
    rows = np.arange(32)
    assert (forth.before == rows).all() and (forth.after == (rows + 1) % 32).all()
    assert (back.before == rows).all() and (back.after == (rows - 1) % 32).all()
    assert forth.along[0] == 0.0 and back.along[0] == 0.0
    assert not forth.left.any() and not back.left.any(), "on the line is not to the left of it"


@pytest.mark.parametrize("direction", [COUNTER_CLOCKWISE, CLOCKWISE])
def test_a_track_that_is_turned_round_is_the_track_driven_backwards(direction: str) -> None:
    track = make_preset("chicane", direction=direction)
    turned = track.turned_round()
    assert {track.direction, turned.direction} == {COUNTER_CLOCKWISE, CLOCKWISE}
    draws = np.random.default_rng(3)
    points = draws.uniform(-9, 9, (500, 2)) * [1, 0.4]
    there, here = project(track, points, backwards=True), project(turned, points)
    np.testing.assert_allclose(here.point, there.point, atol=1e-12)
    np.testing.assert_allclose(here.along, there.along, atol=1e-9)
    np.testing.assert_array_equal(here.left, there.left)
    np.testing.assert_array_equal(here.before, -there.before % len(track.center))
    np.testing.assert_allclose(np.cos(here.heading - there.heading), 1)


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


def test_crossing_the_start_line_counts_as_progress() -> None:
    track = square()
    np.testing.assert_allclose(advance(track, [15.9, 0.2, 3.0, 5.0], [0.2, 15.9, 3.5, 4.0]), [0.3, -0.3, 0.5, -1.0])


def test_many_points_at_once_give_the_same_results_as_one() -> None:
    track = make_preset("oval", spacing=0.02)  # 1,000 waypoints: three blocks
    points = np.random.default_rng(1).uniform(-4, 4, (2500, 2))
    whole, one = project(track, points), project(track, points[2345])
    assert (whole.along[2345], whole.before[2345]) == (one.along[0], one.before[0])
    assert on_road(track, points)[2345] == on_road(track, points[2345])[0]
