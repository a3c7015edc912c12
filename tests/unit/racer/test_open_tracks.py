"""Open tracks, from a start line to the end of their line: files, geometry, and cars that drive them."""

from __future__ import annotations

import io
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from racer.car.scenery import _roads, _strip
from racer.car.task import Racer, RacerPixels
from racer.rewards.parameters import NUMBER_COLUMNS
from racer.settings.task import FrontCameraConfig, ObstacleConfig, RacerConfig, RacerPixelsConfig, RewardFile
from racer.tracks.arithmetic import norm
from racer.tracks.checks import BadTrack
from racer.tracks.circuit import circuit_of
from racer.tracks.geometry import advance, on_road, place_at, project
from racer.tracks.naming import keep
from racer.tracks.picture import picture_of
from racer.tracks.race_track import Track
from racer.tracks.route_file import from_bytes, to_bytes
from shared_store.volume.layout import Store
from tests.support.racer.racing import OVAL, ahead, counted, known, open_track, straight
from tests.support.refusals import refusal

HORSESHOE = open_track()
END = HORSESHOE.length
OPEN = f"taken as an open track; its ends are {math.dist(*HORSESHOE.center[[0, -1]]):.2f} m apart"


@pytest.fixture(autouse=True)
def store(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Store:
    store = Store(tmp_path).open()
    keep(store, HORSESHOE, {})
    monkeypatch.setenv("MUSTER_STORE", str(tmp_path))
    return store


def driver(worlds: int = 1, **fields: Any) -> Racer:
    return Racer(RacerConfig(track="horseshoe", start=fields.pop("start", "line"), **fields), worlds, seed=3)


def file(rows: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.save(stream, rows)
    return stream.getvalue()


def test_the_measures_of_an_open_track_end_at_its_last_waypoint() -> None:
    assert len(HORSESHOE.steps) == 79 and len(HORSESHOE.along) == len(HORSESHOE.width) == 80
    assert pytest.approx(OVAL.along[79], rel=1e-12) == END and HORSESHOE.along[-1] == END
    facts = HORSESHOE.facts()
    assert (facts["direction"], facts["waypoints"], facts["closed"]) == ("open", 80, False)
    assert HORSESHOE.rows().shape == (80, 6) and HORSESHOE.line().shape == (80, 2) and OVAL.line().shape == (134, 2)
    line = np.stack((np.arange(0, 6, 0.25), np.zeros(24)), -1)
    assert Track("line", line, line + np.array([0, 0.4]), line - np.array([0, 0.4]), closed=False).least_radius == 1e4


def test_an_open_track_comes_back_from_its_file_with_its_borders_the_right_way() -> None:
    for track in (HORSESHOE, HORSESHOE.turned_round()):
        found = from_bytes(to_bytes(track), "again")
        assert (found.track.digest, found.track.closed, found.notes) == (track.digest, False, (OPEN,))
    swapped = from_bytes(file(HORSESHOE.rows()[:, [0, 1, 4, 5, 2, 3]]), "again")
    assert swapped.track.digest == HORSESHOE.digest
    assert swapped.notes == (
        OPEN,
        "the borders were swapped (columns 2 and 3 lie right of the centre line): taken the right way",
    )
    twice = from_bytes(file(np.repeat(HORSESHOE.rows(), 2, axis=0)), "again")
    assert twice.track.digest == HORSESHOE.digest and twice.notes[1].startswith("left out 80 rows")


def test_a_loop_of_which_the_last_rows_are_missing_is_not_an_open_track() -> None:
    words = refusal(from_bytes, file(OVAL.rows()[:-4]), "x", error=BadTrack)
    assert (
        words.startswith("the centre line is open: 0.6") and "the last row of a loop has to be the first one" in words
    )
    rows = HORSESHOE.rows()
    rows[-1, 2:4] = rows[0, 2:4]
    assert "the centre line is open" in refusal(from_bytes, file(rows), "x", error=BadTrack)
    sides = {"center": HORSESHOE.center, "inner": HORSESHOE.outer, "outer": HORSESHOE.inner}
    assert "has its inner border on the left" in refusal(Track, "x", **sides, closed=False, error=BadTrack)


def test_a_coarse_loop_without_its_closing_row_is_not_an_open_track() -> None:
    turn = 2 * np.pi * np.arange(24) / 24
    ring = np.stack((np.cos(turn), np.sin(turn)), -1)
    rows = np.hstack((4.0 * ring, 3.7 * ring, 4.3 * ring))  # its steps are longer than its road is wide
    assert refusal(from_bytes, file(rows), "x", error=BadTrack).startswith("the centre line is open: 1.044 m lie")
    closed = from_bytes(file(np.vstack((rows, rows[:1]))), "x")
    assert (closed.track.closed, closed.notes) == (True, ())


def test_a_loop_with_a_border_that_is_open_by_a_row_or_less_is_a_loop() -> None:
    rows = OVAL.rows()
    closing = norm(OVAL.outer[-1] - OVAL.outer[0])
    rows[-1, 4:6] = rows[0, 4:6] + np.array([-closing, 0.0])
    found = from_bytes(file(rows), "x")
    assert found.track.digest == OVAL.digest
    assert found.notes == (
        f"the outer border is open by {closing:.3f} m, no more than its rows are apart: taken as a loop without its last point",
    )
    rows[-1, 4] -= 0.2
    assert refusal(from_bytes, file(rows), "x", error=BadTrack).startswith("the outer border is open: 0.")


def test_places_on_an_open_track_end_at_its_ends() -> None:
    points, headings = place_at(HORSESHOE, [-3.0, 0.0, 2.0, END, END + 5.0])
    np.testing.assert_allclose(points[[0, 1, 3, 4]], HORSESHOE.center[[0, 0, -1, -1]])
    np.testing.assert_allclose(place_at(HORSESHOE, [0.0, 2.0, END + 1], True)[0][[0, 2]], HORSESHOE.center[[-1, 0]])
    np.testing.assert_allclose(headings[:2], 0.0, atol=1e-12)
    before, behind = HORSESHOE.center[0] - [1.0, -0.1], HORSESHOE.center[-1] - [1.0, -0.1]
    found, back = (project(HORSESHOE, [before, behind], backwards) for backwards in (False, True))
    assert found.along.tolist() == [0.0, END] and back.along.tolist() == [END, 0.0]
    assert (found.before[1], found.after[1]) == (78, 79)
    np.testing.assert_allclose(found.distance, math.hypot(1.0, 0.1))
    assert found.left.tolist() == [True, False]
    assert advance(HORSESHOE, [0.1, END], [END, 0.1]).tolist() == pytest.approx([END - 0.1, 0.1 - END])


def test_an_open_road_lies_between_its_borders_and_its_ends() -> None:
    points, headings = place_at(HORSESHOE, np.linspace(0.01, END - 0.01, 50))
    left = np.stack((-np.sin(headings), np.cos(headings)), -1)
    assert on_road(HORSESHOE, points).all() and on_road(HORSESHOE, points + 0.45 * left).all()
    assert not on_road(HORSESHOE, points + 0.55 * left).any() and not on_road(HORSESHOE, points - 0.55 * left).any()
    assert not on_road(HORSESHOE, [HORSESHOE.center[0] - [0.1, 0], HORSESHOE.center[-1] - [0.1, 0], [0.0, 0.0]]).any()
    inner, outer = _roads(HORSESHOE)[0]
    corners, triangles = _strip(inner, outer, closed=False)
    assert len(triangles) == 2 * 79 and triangles.max() == 159 and len(corners) == 160


def test_a_car_drives_from_the_start_to_the_end_which_completes_its_lap() -> None:
    task = driver(rewards={"progress": 1.0, "off_track": 0.0, "crashed": 0.0}, trace=True)
    assert known(task, "wheels")[0] == 4 and known(task, "along")[0] == pytest.approx(0.29, abs=1e-4)
    earned, progress, steps = 0.0, [], 0
    while not task.dones[0]:
        task.step(ahead(task))
        earned, steps = earned + task.rewards[0].item(), steps + 1
        progress.append(known(task, "trace")[0, 6])
    assert progress[0] < 1.0 and np.diff(progress).min() >= 0 and progress[-1] == 100.0 and progress[-2] < 100.0
    assert counted(task, "termination_lap_complete") == 1 and counted(task, "termination_off_track") == 0
    assert counted(task, "metric_lap_time") == pytest.approx(steps / 15, rel=1e-5)
    assert earned == pytest.approx(100 * (END - 0.29) / END, abs=0.1)
    assert known(task, "along")[0] < 0.5  # the next episode begins at the start


def test_an_episode_that_begins_farther_on_makes_a_lap_of_the_rest_and_no_lap_time() -> None:
    task = driver(8, start="round_robin", start_step=0.11)
    started = known(task, "along")
    assert (known(task, "wheels") == 4).all() and started.max() < END - 0.8 and np.ptp(started) > 0.6 * END
    first = task.first_world
    assert first == 0
    done = np.zeros(8, bool)
    for _ in range(200):
        task.step(ahead(task))
        done |= task.dones.numpy().astype(bool)
        if done.all():
            break
    assert done.all() and counted(task, "termination_lap_complete") == counted(task, "episodes")
    assert counted(task, "metric_progress") == pytest.approx(100 * counted(task, "episodes"))
    alone = driver(start="line")
    length = 0
    while not alone.dones[0]:
        alone.step(ahead(alone))
        length += 1
    assert counted(task, "metric_lap_time") == pytest.approx(length / 15, rel=1e-4)  # that of the one from the line


def test_every_other_episode_drives_back_from_the_end() -> None:
    task = driver(alternate_direction=True)
    seen = []
    for _ in range(2):
        seen.append((bool(known(task, "backwards")[0]), known(task, "fronts")[0]))
        task.step(ahead(task))
        while not task.dones[0]:
            task.step(ahead(task))
    assert counted(task, "termination_lap_complete") == 2
    assert [each[0] for each in seen] == [False, True]
    np.testing.assert_allclose(seen[1][1], HORSESHOE.center[-1] + [0.29, 0], atol=1e-3)


def test_what_a_policy_sees_ahead_ends_at_the_end() -> None:
    task = driver()
    while known(task, "along")[0] < END - 0.5:
        task.step(ahead(task))
    columns = [task.observation_names.index(f"waypoint_{number}_x") for number in (2, 7)]
    third, last = (task.observations[0, column : column + 2].numpy() for column in columns)
    np.testing.assert_array_equal(third, last)
    assert 0.0 < np.hypot(*last) < 0.6


REWARD = """
def reward_function(params):
    w, (a, b) = params["waypoints"], params["closest_waypoints"]
    return b + 1000.0 * len(w) + 0.001 * params["progress"]
"""


def test_a_reward_function_has_the_waypoints_of_the_line_which_do_not_wrap() -> None:
    boxes = (ObstacleConfig(2.0, "outer"), ObstacleConfig(END - 2.0, "outer"))
    task = driver(reward_function=RewardFile("r.py", REWARD), obstacles=boxes)
    rewards, nearest = [], []
    while not task.dones[0]:
        task.step(ahead(task))
        rewards.append(task.rewards[0].item())
        nearest.append(task.sensors["race"].arrays.numbers.numpy()[0].copy())
    assert rewards[0] == pytest.approx(80_003, abs=0.1) and rewards[-1] == pytest.approx(80_079.1, abs=0.02)
    before = NUMBER_COLUMNS["closest_objects"]
    after = before + 1
    # as AWS's simulator does: the first object where none is ahead, the last one where none is behind
    assert {(int(row[before]), int(row[after])) for row in nearest} == {(1, 0), (0, 1)}


def test_a_box_behind_is_not_ahead_on_an_open_track() -> None:
    task = driver(obstacles=(ObstacleConfig(1.0, "outer"),))
    column = task.observation_names.index("obstacle_ahead")
    assert task.observations[0, column].item() == pytest.approx(0.71, abs=0.02)
    while known(task, "along")[0] < END - 1.0:
        task.step(ahead(task))
    assert task.observations[0, column].item() == 4.0
    poses = circuit_of([HORSESHOE], [ObstacleConfig(END - 0.01, "inner")]).obstacle_poses
    assert project(HORSESHOE, poses[0, :, :2]).along[0] == pytest.approx(END - 0.01)


def test_a_car_is_put_back_onto_the_road_and_not_before_its_start() -> None:
    task = driver(continuous=True, start_turned=(0.8, 0.8))
    for _ in range(30):
        task.step(straight(task))
        if known(task, "put")[0]:
            break
    assert known(task, "put")[0]
    np.testing.assert_allclose(known(task, "poses")[0], [*(HORSESHOE.center[0] + [0.15, 0]), 0.0], atol=1e-3)
    while not task.dones[0]:
        task.step(ahead(task))
    assert counted(task, "termination_lap_complete") == 1


def test_a_fast_car_that_passes_the_end_is_not_off_the_track() -> None:
    ranges = {"steering_angle": {"low": -30, "high": 30}, "speed": {"low": 0.5, "high": 4.0}}
    space = {"action_space": ranges, "action_space_type": "continuous"}
    task = driver(64, start="random", start_sideways=(-0.05, 0.05), action_space=space, speed_lag=0.0)
    for _ in range(40):
        task.step(ahead(task, 1.0))
    assert counted(task, "termination_lap_complete") > 30 and counted(task, "termination_off_track") == 0


def test_an_open_track_is_drawn_and_seen_without_a_piece_that_closes_it() -> None:
    image = Image.open(io.BytesIO(picture_of(HORSESHOE))).convert("RGB")
    pixels = np.asarray(image).astype(int)
    asphalt = np.abs(pixels - [0xD9, 0xDC, 0xE1]).max(axis=2) < 8
    low, high = np.flatnonzero(asphalt.any(axis=1))[[0, -1]]
    middle = asphalt[(low + high) // 2]
    assert (
        middle[: len(middle) // 2].sum() == 0 < middle[len(middle) // 2 :].sum()
    )  # no road on the left side, where it is open
    front = FrontCameraConfig(width=32, height=24, kind="color")
    task = RacerPixels(RacerPixelsConfig(track="horseshoe", front=front, start="line"), 1, seed=1)
    red, green, blue = task.observations[0].int()
    grey = (red < 80) & ((red - green).abs() < 10) & ((blue - green).abs() < 20)
    assert grey.float().mean() > 0.2
