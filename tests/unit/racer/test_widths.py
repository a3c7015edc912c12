"""Tracks with border rows that are not level with the waypoints, as in many of the community's files: what is across the road counts."""

from __future__ import annotations

import io
import json
from typing import Any

import numpy as np
import pytest

from racer.car.scenery import _roads, _strip
from racer.car.task import Racer
from racer.settings.task import ObstacleConfig, RacerConfig
from racer.store import tracks as stored
from racer.tracks import __main__ as command
from racer.tracks.arithmetic import norm
from racer.tracks.circuit import circuit_of
from racer.tracks.generator import make_random
from racer.tracks.geometry import advance, on_road, place_at, project
from racer.tracks.naming import keep, resolve
from racer.tracks.presets import PRESETS, make_preset
from racer.tracks.race_track import Track
from racer.tracks.road import road_arrays
from racer.tracks.route_file import from_bytes, to_bytes
from shared_store.volume.layout import Store
from tests.support.racer.racing import known


def ring(radius: float, turned: float = 0.0, count: int = 120) -> np.ndarray:
    angles = 2 * np.pi * np.arange(count) / count + turned
    return radius * np.stack((np.cos(angles), np.sin(angles)), -1)


def skewed(turned: float = 0.2) -> Track:
    """A ring road of 1 m; each border row is ``turned`` [rad] before or behind its waypoint."""
    return Track("skewed", ring(3.0), ring(2.5, turned), ring(3.5, -turned))


@pytest.mark.parametrize("turned", [0.0, 0.05, 0.2, -0.4])
def test_the_width_is_measured_across_the_road_wherever_the_border_rows_are(turned: float) -> None:
    track = skewed(turned)
    np.testing.assert_allclose(track.width, 1.0, atol=2e-3)
    assert track.facts()["width"] == pytest.approx([1.0, 1.0], abs=2e-3)
    assert track.slanted == (120 if turned else 0)
    points, _ = place_at(track, np.linspace(0, 18, 77))
    np.testing.assert_allclose(project(track, points).width, 1.0, atol=2e-3)
    np.testing.assert_array_equal(road_arrays([track], np.zeros((1, 2)), "cpu").width.numpy(), track.width.astype("f4"))
    inner, outer = track.beside
    np.testing.assert_allclose(inner, ring(2.5), atol=0.02)
    np.testing.assert_allclose(outer, ring(3.5), atol=0.02)


def test_both_borders_may_be_shifted_the_same_way() -> None:
    track = Track("shifted", ring(3.0), ring(2.5, 0.2), ring(3.5, 0.2))
    np.testing.assert_allclose(track.beside[1], ring(3.5), atol=0.01)
    np.testing.assert_allclose(track.width, 1.0, atol=2e-3)


def test_rows_of_made_tracks_stay_what_they_are_to_the_last_bit() -> None:
    for track in (*map(make_preset, PRESETS), *map(make_random, range(40))):
        assert track.slanted == 0
        np.testing.assert_array_equal(track.width, norm(track.outer - track.inner))


def test_a_hairpin_is_as_wide_as_its_nearest_border_says() -> None:
    """A spike of the inner border leaves the row in the curve's bend level, and the road narrower beside it."""
    track = make_preset("oval")
    inner = track.inner.copy()
    inner[40] += 0.3 * (track.center[40] - inner[40])
    narrow = Track("narrow", track.center, inner, track.outer)
    assert narrow.width[40] == pytest.approx(0.85, abs=1e-3)
    assert narrow.width[39] < 0.99 and narrow.width[37] == track.width[37]


def test_boxes_stand_at_the_distance_that_was_declared() -> None:
    track = skewed()
    boxes = [ObstacleConfig(distance, lane) for distance in (0.0, 4.1, 12.7) for lane in ("inner", "center", "outer")]
    circuit = circuit_of([track], boxes)
    found = project(track, circuit.obstacle_poses[0, :, :2])
    np.testing.assert_allclose(advance(track, [box.distance for box in boxes], found.along), 0, atol=0.02)
    np.testing.assert_allclose(found.distance, [0.25, 0.0, 0.25] * 3, atol=0.01)


def test_a_car_that_is_put_back_beside_a_box_stands_on_the_road(tmp_path: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    keep(Store(tmp_path).open(), skewed(0.4), {})
    monkeypatch.setenv("MUSTER_STORE", str(tmp_path))
    config = RacerConfig(track="skewed", start="line", continuous=True, obstacles=(ObstacleConfig(1.2, "center"),))
    task = Racer(config, 1, seed=3)
    assert (
        task.notes()[-1]
        == "track skewed: 120 of 120 rows of its borders are not level with their waypoint: widths are taken across the road"
    )
    assert known(task, "widths")[0] == pytest.approx(1.0, abs=2e-3)
    controls = task.observations.new_tensor([[0.12 / 0.5236, 0.0]])
    for _ in range(40):
        task.step(controls)
        if known(task, "put")[0]:
            break
    assert known(task, "put")[0]
    x, y, _ = known(task, "poses")[0]
    assert abs(np.hypot(x, y) - 3.0) == pytest.approx(0.25, abs=0.02)
    assert known(task, "wheels")[0] == 4


@pytest.mark.parametrize("track", [skewed(0.4), skewed(), make_preset("oval")], ids=lambda track: track.name)
def test_the_asphalt_covers_the_road_and_nothing_else(track: Track) -> None:
    points = np.random.default_rng(1).uniform(-8, 8, (6000, 2))
    covered = np.zeros(len(points), bool)
    for inner, outer in _roads(track):
        corners, triangles = _strip(inner, outer)
        for a, b, c in corners[triangles]:
            sides = [
                np.sign((q - p)[0] * (points - p)[:, 1] - (q - p)[1] * (points - p)[:, 0])
                for p, q in ((a, b), (b, c), (c, a))
            ]
            covered |= np.abs(sum(sides)) == 3
    road = on_road(track, points)
    assert road.sum() > 300
    assert (covered != road).sum() <= 3


def test_what_an_import_and_older_manifests_say(tmp_path: Any, capsys: pytest.CaptureFixture[str]) -> None:
    store = Store(tmp_path).open()
    found = from_bytes(to_bytes(skewed()), "skewed")
    assert found.notes == (
        "120 of 120 rows of its borders are not level with their waypoint: widths are taken across the road",
    )
    stored.add(
        store, "skewed", to_bytes(skewed()), {**skewed().facts(), "width": [1.54, 1.54], "origin": {"file": "x"}}
    )
    for action in ("show", "list"):
        assert command.main({"action": action, "name": "skewed", "store": str(tmp_path)}) == 0
        answer = json.load(io.StringIO(capsys.readouterr().out))
        track = answer if action == "show" else answer[-1]
        assert track["width"] == pytest.approx([1.0, 1.0], abs=2e-3) and track["origin"] == {"file": "x"}
    assert resolve("skewed", store).width.max() < 1.002
