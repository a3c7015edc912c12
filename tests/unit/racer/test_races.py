"""Races in the store: rules of a job's section, the table that a person reads, standings by hand."""

from __future__ import annotations

import copy
from typing import Any

import pytest

from racer.store.races import clock, race_changes, rules_of
from racer.store.standings import BadRace, Contender, RaceResults, Ranking, differences, read_race, table
from shared_store.volume.evaluations import lines
from tests.support.racer.leagues import race


def test_a_race_is_three_laps_that_end_with_the_first_incident_with_times_in_milliseconds() -> None:
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


def contender(entry: int, times: list[int], racer: str = "", laps: int = 3, **facts: Any) -> Contender:
    """``times`` in milliseconds."""
    counts = {key: facts.pop(key, 0) for key in ("resets", "off_tracks", "crashes")}
    driven = RaceResults(laps, tuple(time / 1000 for time in times), **counts)
    return Contender(entry, racer or f"r{entry}", f"m@{entry}", driven, **facts)


@pytest.mark.parametrize(
    ("times", "total", "best", "average"),
    [
        ([12_000, 12_500, 13_001], 37_501, 12_000, 12_500),  # 37501 / 3 = 12500.3
        ([12_000, 13_002], None, 12_000, 12_501),
        ([15_000], None, 15_000, 15_000),
        ([], None, None, None),
    ],
)
def test_total_requires_every_lap_and_other_rankings_use_complete_ones(
    times: list[int], total: int | None, best: int | None, average: int | None
) -> None:
    driven = RaceResults(3, tuple(time / 1000 for time in times), 0, 0, 0)
    assert [driven.counts(ranking) for ranking in ("total", "best", "average")] == [total, best, average]


def test_a_race_is_read_with_its_penalties_and_its_times_are_equal_to_the_millisecond() -> None:
    driven = read_race(race([14.3404, 12.2, None], off_tracks=2, resets=2))
    assert driven == RaceResults(laps=3, times=(14.3404, 12.2), resets=2, off_tracks=2, crashes=0)
    earlier, later = (read_race(race([time], off_tracks=0)) for time in (12.3404, 12.3396))
    rows = table([Contender(1, "a", "m@1", earlier), Contender(2, "b", "m@2", later)], "total")
    assert [(row.rank, row.racer, row.time) for row in rows] == [(1, "a", 12.34), (2, "b", 12.34)]
    driven = read_race(race([10.46666666666667] * 3))
    assert (driven.counts("total"), driven.counts("average"), driven.best) == (31_400, 10_467, 10_467)  # not 31401


@pytest.mark.parametrize(
    ("change", "output"),
    [
        (lambda found: found["trials"].pop(), "race: expected rules.laps and as many trials, found laps 3"),
        (lambda found: found["rules"].pop("laps"), "race: expected rules.laps and as many trials, found laps None"),
        (lambda found: found["trials"].reverse(), "race.trials.0: expected trial 1 with its status"),
        (lambda found: found["trials"][1].update(time=None), "race.trials.1.time: expected the lap's time in seconds"),
        (lambda found: found["trials"][1].update(time=-1.0), "race.trials.1.time: expected the lap's time in seconds"),
        (lambda found: found["trials"][1].update(time=float("inf")), "race.trials.1.time: expected the lap's time"),
        (lambda found: found["trials"][2].update(resets=-1), "race.trials.2.resets: expected an integer, found -1"),
        (lambda found: found["trials"][2].update(crashes="1"), "race.trials.2.crashes: expected an integer"),
    ],
)
def test_a_malformed_race_is_refused_with_its_place(change: Any, output: str) -> None:
    found = race([12.0, 12.5, 13.0])
    change(found)
    with pytest.raises(BadRace, match=f"^{output}"):
        read_race(found)
    with pytest.raises(BadRace, match="it is not a race: its summary has no key race"):
        read_race(None)


@pytest.mark.parametrize(("ranking", "order"), [("total", [2, 1]), ("best", [3, 1, 2]), ("average", [3, 2, 1])])
def test_the_ranking_orders_the_entries(ranking: Ranking, order: list[int]) -> None:
    entries = [contender(1, [11_000, 13_000, 13_000]), contender(2, [12_000] * 3), contender(3, [10_000])]
    rows = table(entries, ranking)
    assert [row.entry for row in rows if row.rank] == order
    assert [row.rank for row in rows if row.rank] == list(range(1, len(order) + 1))
    if ranking == "total":
        assert (rows[-1].status, rows[-1].reason, rows[-1].time) == ("incomplete", "1 of 3 laps complete", None)
        assert [rows[0].time, rows[0].best_lap] == [36.0, 12.0]


def test_equal_times_are_parted_by_resets_then_off_tracks_then_the_earlier_entry() -> None:
    entries = [
        contender(1, [36_000], laps=1, resets=2, off_tracks=0),
        contender(2, [36_000], laps=1, resets=1, off_tracks=3),
        contender(3, [36_000], laps=1, resets=1, off_tracks=2),
        contender(4, [36_000], laps=1, resets=1, off_tracks=2),
        contender(5, [36_001], laps=1, resets=0, off_tracks=0),
    ]
    assert [(row.rank, row.entry) for row in table(entries, "total")] == [(1, 3), (2, 4), (3, 2), (4, 1), (5, 5)]
    assert table(list(reversed(entries)), "total") == table(entries, "total")


def test_of_a_racer_the_best_entry_is_ranked() -> None:
    entries = [
        contender(1, [40_000], "ada", 1),
        contender(2, [38_000], "ada", 1),
        contender(3, [39_000], "bob", 1),
        contender(4, [], "ada", 1),
    ]
    assert [(row.rank, row.entry) for row in table(entries, "total")] == [(1, 2), (2, 3)]
    rows = table(entries, "total", every=True)
    assert [(row.entry, row.status) for row in rows[2:]] == [(1, "slower"), (4, "incomplete")]
    assert rows[2].reason == "entry 2 of the same racer is ranked" and rows[2].time == 40.0


def test_a_disqualified_or_altered_entry_is_shown_and_not_ranked_and_the_racer_s_next_one_is() -> None:
    entries = [
        contender(1, [30_000], "ada", 1, disqualified="another car"),
        contender(2, [38_000], "ada", 1),
        contender(3, [37_000], "bob", 1),
        Contender(4, "-", "-", None, problem="its digest differs"),
    ]
    rows = table(entries, "total")
    assert [(row.rank, row.entry, row.status, row.reason) for row in rows] == [
        (1, 3, "ranked", ""),
        (2, 2, "ranked", ""),
        (None, 1, "disqualified", "another car"),
        (None, 4, "altered", "its digest differs"),
    ]
    assert (rows[3].time, rows[3].completed, rows[3].resets) == (None, None, None)


def test_two_races_are_compared_bit_by_bit() -> None:
    before = race([12.0, 12.5, 13.0])
    assert differences(before, copy.deepcopy(before)) == []
    after = copy.deepcopy(before)
    after["trials"][1] |= {"time": 12.500000000000002, "lap_time": 12.500000000000002}
    after["trials"][2]["status"] = "off_track"
    assert differences(before, after) == [
        "trial 2: lap_time 12.5 became 12.500000000000002",
        "trial 2: time 12.5 became 12.500000000000002",
        "trial 3: status lap_complete became off_track",
    ]
    assert differences(before, race([12.0]))[-1] == "3 trials became 1"
    assert differences(before, {**before, "track": ["chicane"]}) == ["track: ['oval'] became ['chicane']"]
