"""The samples of a reward function's check: they come from the tracks and obstacles of its job."""

from __future__ import annotations

import json
import random
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from racer.car.courses import courses_for, courses_of
from racer.rewards.__main__ import main
from racer.rewards.guard import check_source
from racer.rewards.parameters import row_of
from racer.rewards.samples import FINE_OVAL, oval_track, random_sample
from racer.settings.task import ObstacleConfig, RewardFile
from racer.tracks.circuit import circuit_of
from racer.tracks.geometry import on_road, project
from racer.tracks.naming import keep, resolve
from racer.tracks.presets import make_preset
from racer.tracks.race_track import Track
from shared_store.volume.layout import Store
from tests.support.racer.racing import OVAL, open_track, racer
from tests.support.refusals import refusal

NEXT = """def reward_function(params):
    _, ahead = params["closest_objects"]
    gap = params["objects_distance"][ahead] - params["projection_distance"]
    return 0.2 if 0.0 < gap < 0.8 else 1.0
"""
FAR = "def reward_function(params):\n    return params['waypoints'][140][0]\n"
TURNS = np.linspace(0.0, 2 * np.pi, 120, endpoint=False)
RING = Track("ring", *(radius * np.stack((np.cos(TURNS), np.sin(TURNS)), 1) for radius in (3.0, 2.4, 3.6)))
BOXES = (ObstacleConfig(2.0, "inner"), ObstacleConfig(8.0, "outer"), ObstacleConfig(9.5, "center"))


def message(source: str, *names: str, boxes: tuple[ObstacleConfig, ...] = ()) -> tuple[str, list[str]]:
    """The guard's answer on these tracks, and its notes."""
    notes: list[str] = []
    courses = courses_of(circuit_of([resolve(name, None) for name in names], boxes))
    return str(check_source(source, "r.py", courses, anyway=True, note=notes.append) or ""), [
        note for note in notes if "no sandbox" not in note
    ]


def test_a_function_that_needs_objects_is_valid_with_the_job_s_and_noted_without() -> None:
    assert message(NEXT, "oval", boxes=BOXES) == ("", [])
    problem, (note,) = message(NEXT, "oval")
    assert problem == "" and note == (
        "r.py:3: it fails where there are no objects, as in this job (the sample 'start': IndexError: list index out of range, "
        "on track oval with 133 waypoints); it is valid, since it passes with objects, with which AWS tries it: add obstacles"
    )
    broken = NEXT.replace('["closest_objects"]', '["closest_object"]')
    assert message(broken, "oval") == (
        "r.py:2: TEST_FAILURE: the sample 'start': KeyError: 'closest_object', on track oval with 133 waypoints",
        [],
    )


def test_a_function_that_fails_with_objects_is_valid_in_a_job_without() -> None:
    many = "def reward_function(params):\n    return 1.0 / (3 - len(params['objects_speed']))\n"
    assert message(many, "oval") == ("", [])
    problem, _ = message(many, "oval", boxes=BOXES)
    assert (
        problem
        == "r.py:2: TEST_FAILURE: the sample 'start': ZeroDivisionError: float division by zero, on track oval with 133 waypoints"
    )


def test_a_waypoint_that_the_job_s_track_has_may_be_asked_for() -> None:
    assert message(FAR, "chicane") == ("", [])
    problem = "r.py:2: TEST_FAILURE: the sample 'start': IndexError: list index out of range, on track oval with 133 waypoints"
    assert message(FAR, "oval")[0] == message(FAR, "chicane", "oval")[0] == problem
    assert check_source(FAR, "r.py", [FINE_OVAL], anyway=True) is None


def test_of_tracks_that_are_drawn_one_is_tried_and_of_others_each() -> None:
    names = ("random:3", "oval", "random:4", "oval", "chicane")
    courses = courses_of(circuit_of([resolve(name, None) for name in names], ()))
    assert [course.name for course in courses] == ["random:3", "oval", "chicane"]


@pytest.mark.parametrize(
    "track",
    [OVAL, make_preset("chicane", direction="clockwise", width=0.6), open_track(), open_track().turned_round(), RING],
    ids=["oval", "clockwise", "open", "open, back", "ring"],
)
@pytest.mark.parametrize("boxes", [(), BOXES], ids=["without", "with"])
def test_samples_are_what_a_car_on_the_track_sees(track: Any, boxes: tuple[ObstacleConfig, ...]) -> None:
    circuit = circuit_of([track], boxes)
    (course,) = courses_of(circuit)
    trials = course.trials()
    assert [len(each["start"]["objects_speed"]) for each in trials] == ([3] if boxes else [0, 6])
    for samples in trials:
        for name, params in samples.items():
            back = params["is_reversed"]
            found = project(track, [[params["x"], params["y"]]], back)
            assert params["projection_distance"] == pytest.approx(found.along[0], abs=1e-6), name
            assert params["closest_waypoints"] == [found.before[0], found.after[0]], name
            assert params["progress"] == pytest.approx(100.0 if name == "finish" else found.progress[0], abs=1e-6)
            assert params["distance_from_center"] == pytest.approx(found.distance[0], abs=1e-6), name
            assert params["track_width"] == pytest.approx(found.width[0], abs=0.03)
            assert params["is_offtrack"] == (name == "off-track")
            assert on_road(track, [[params["x"], params["y"]]])[0] == (name != "off-track"), name
            np.testing.assert_array_equal(params["waypoints"], track.line()[:: -1 if back else 1])
            assert max(params["closest_waypoints"]) < len(params["waypoints"])
            places = np.array(params["objects_location"]).reshape(-1, 2)
            present = project(track, places, back)
            np.testing.assert_allclose(present.along, params["objects_distance"], atol=0.06)
            np.testing.assert_array_equal(
                present.left[present.distance > 0.01],
                np.array(params["objects_left_of_center"], bool)[present.distance > 0.01],
            )
            if len(places):
                gaps = np.array(params["objects_distance"]) - params["projection_distance"]
                ahead = gaps % (track.length if track.closed else 2 * track.length)
                if name not in ("objects", "crashed"):  # there the next box is level with the car, or nearly so
                    assert params["closest_objects"] == [ahead.argmax(), ahead.argmin()], name
            if boxes:
                np.testing.assert_allclose(places, circuit.obstacle_poses[0, :, :2], atol=0.05)
            row_of(params)


@pytest.mark.parametrize("track", [RING, OVAL, open_track()], ids=["ring", "oval", "open"])
def test_a_car_of_a_random_sample_is_at_the_place_of_the_line_that_is_nearest_to_it(track: Track) -> None:
    chance = random.Random(3)
    for params in (random_sample(track, chance) for _ in range(200)):
        found = project(track, [[params["x"], params["y"]]], params["is_reversed"])
        assert params["projection_distance"] == pytest.approx(found.along[0], abs=1e-6)
        assert params["closest_waypoints"] == [found.before[0], found.after[0]]
        assert params["distance_from_center"] == pytest.approx(found.distance[0], abs=1e-6)


def test_distances_and_sides_of_a_reversed_sample_are_those_in_driving_direction() -> None:
    boxes = (ObstacleConfig(2.0, "inner"), ObstacleConfig(8.0, "outer"), ObstacleConfig(15.0, "inner"))
    (course,) = courses_of(circuit_of([OVAL], boxes))
    params = course.trials()[0]["reversed"]
    assert params["projection_distance"] == pytest.approx(
        OVAL.length - 3.3 * OVAL.length / oval_track().length, abs=0.01
    )
    assert params["objects_distance"] == pytest.approx([OVAL.length - way for way in (2.0, 8.0, 15.0)], abs=0.01)
    assert params["objects_left_of_center"] == [False, True, False]
    assert params["closest_objects"] == [1, 0]


def test_the_command_tries_the_tracks_that_it_finds_and_says_which_it_does_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    keep(Store(tmp_path / "store").open(), make_preset("oval", "short", length=12.0), {})
    file = tmp_path / "far.py"
    file.write_text(FAR)

    def run(config: Any, *more: str) -> tuple[int, list[str]]:
        monkeypatch.setattr(sys, "argv", ["rewards", str(file), "--config", json.dumps(config), *more])
        code = main()
        errors = [line for line in capsys.readouterr().err.splitlines() if "no sandbox" not in line]
        return code, errors

    assert run({"track": "chicane"}) == (0, [])
    code, (problem,) = run({"track": "short"}, "--store", str(tmp_path / "store"))
    assert (
        code == 1
        and problem
        == f"{file}:2: TEST_FAILURE: the sample 'start': IndexError: list index out of range, on track short with 80 waypoints"
    )
    code, notes = run({"track": "short"})
    assert code == 0 and notes[0].startswith(
        f"{file}: it is not tried on track short, but on the job's nodes (track 'short': there is no such"
    )
    assert notes[1] == f"{file}: it is tried on an oval of 602 waypoints instead"
    code, notes = run({"track": ["chicane", "short"]})
    assert code == 0 and len(notes) == 1
    code, (note,) = run({"track": "oval", "obstacles": [{"distance": 99.0}]})
    assert (
        code == 0
        and "it is tried on an oval, not on the job's tracks (obstacles.0.distance: 99 m is beyond the end" in note
    )


def test_settings_that_are_wrong_are_another_s_to_refuse() -> None:
    for config in ({"track": 3}, {"obstacles": "none"}, {"obstacles": [{"lane": "middle"}]}):
        courses, notes = courses_for(config, None)
        assert courses == (FINE_OVAL,) and len(notes) == 1


def test_a_rank_tries_its_function_on_its_own_track_and_notes_what_needs_objects() -> None:
    words = refusal(racer, track="oval", reward_function=RewardFile("far.py", FAR), error=ValueError)
    assert words.endswith(
        "far.py:2: TEST_FAILURE: the sample 'start': IndexError: list index out of range, on track oval with 133 waypoints"
    )
    task = racer(track="chicane", reward_function=RewardFile("far.py", FAR))
    assert not [note for note in task.notes() if "objects" in note]
    noted = racer(track="oval", reward_function=RewardFile("next.py", NEXT))
    assert [
        note
        for note in noted.notes()
        if note.startswith("next.py:3: it fails where there are no objects, as in this job")
    ]
