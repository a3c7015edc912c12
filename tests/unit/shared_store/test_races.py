"""Races in the store: rules of a job's section, what they change of a task, and the table that a person reads."""

from __future__ import annotations

from typing import Any

import pytest

from shared_store.evaluations import lines
from shared_store.races import clock, key_of, race_changes, rules_of


def test_a_race_is_three_laps_that_end_with_the_first_mishap_with_times_in_milliseconds() -> None:
    expected = {"laps": 3, "continuous": False, "off_track_penalty": 1.0, "crash_penalty": 1.0, "max_resets": 100}
    assert rules_of({"run": "fast"}) == {**expected, "seconds": 1200.0, "ranking": None}
    assert rules_of({"trials": 5, "seconds": 60.0})["laps"] == 5
    assert [clock(seconds) for seconds in (185 / 15, 59.9996, 61.5, 0.0, None)] == [
        *("0:12.333", "1:00.000", "1:01.500", "0:00.000", "-")
    ]


def test_the_rules_of_a_race_stand_above_its_config_and_every_lap_begins_at_the_line() -> None:
    section = {"track": ["oval"], "seconds": 60.0, "config": {"start": "random", "speed_lag": 0.1, "continuous": True}}
    changes = race_changes(section)
    assert changes == {
        **{"speed_lag": 0.1, "track": ["oval"], "episode_seconds": 60.0, "continuous": False, "max_resets": 100},
        **{"off_track_penalty": 1.0, "crash_penalty": 1.0, "start": "line", "trace": True},
        **{"start_sideways": [0.0, 0.0], "start_turned": [0.0, 0.0], "alternate_direction": False},
    }
    assert "track" not in race_changes({})


@pytest.mark.parametrize(
    ("path", "key"),
    [
        (("episode_seconds",), "race.seconds"),
        (("max_resets",), "race.max_resets"),
        (("track", 1), "race.track.1"),
        (("front", "width"), "race.config.front.width"),
    ],
)
def test_an_error_is_reported_by_its_place_in_the_job(path: tuple[str | int, ...], key: str) -> None:
    assert key_of({"track": ["oval"]}, path) == key


def test_a_race_is_printed_as_a_table_of_its_trials() -> None:
    trial = {"trial": 1, "status": "lap_complete", "completion": 100.0, "time": 14.5, "off_tracks": 2, "crashes": 0}
    gone = {"trial": 2, "status": "off_track", "completion": 41.26, "time": 6.0, "off_tracks": 1, "crashes": 0}
    race: dict[str, Any] = {
        "rules": rules_of({"trials": 2, "continuous": True}),
        "track": ["oval", "hills"],
        "trials": [{**trial, "resets": 2}, {**gone, "resets": 0}],
        **{"completed": 1, "best_lap": 14.5, "average_lap": 14.5, "total_time": None},
    }
    printed = list(lines({"race": race, "task": "Racer", "checkpoint": "00000030-e1", "seed": 7}))
    assert printed == [
        "race: 2 laps of Racer on oval, hills, checkpoint 00000030-e1, seed 7",
        "rules: put back, 100 times at most; 1 s off the track, 1 s for a crash; 1200 s for a lap",
        "TRIAL       TIME COMPLETED STATUS       OFF-TRACKS CRASHES RESETS",
        "    1   0:14.500   100.0 % lap_complete          2       0      2",
        "    2   0:06.000    41.3 % off_track             1       0      0",
        "1 of 2 laps complete: best 0:14.500, average 0:14.500, total -",
    ]
