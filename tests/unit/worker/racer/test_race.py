"""Races on simulated worlds: lap times from counted steps, penalties, each end of a trial, step logs, and the same again bit for bit."""

from __future__ import annotations

import csv
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet
import pytest
import torch
from tensordict import TensorDict

from shared_store.layout import Run
from shared_store.races import race_changes, rules_of
from tests.support.worker.loop import alone
from tests.support.worker.racing import OVAL, known
from worker.evaluation.episodes import Episodes, play
from worker.evaluation.evaluation import result_of
from worker.evaluation.race import SIM_TRACE_COLUMNS, Laps, Race
from worker.tasks.configs.racer import RacerConfig
from worker.tasks.overrides import configured
from worker.tasks.racer import Racer


class Driver:
    """Steers for the third waypoint, or straight on, if it learns until it is put back."""

    def __init__(self, task: Racer, gain: float = 1.0, learns: bool = False) -> None:
        self.column = task.observation_names.index("waypoint_2_x")
        self.task, self.gain, self.learns = task, gain, learns

    def act(self, observations: TensorDict) -> torch.Tensor:
        x, y = observations["policy"][:, self.column], observations["policy"][:, self.column + 1]
        if self.learns and known(self.task, "counts").any():
            self.gain = 1.0
        return torch.stack((self.gain * torch.atan2(y, x) / 0.5236, torch.zeros_like(x)), 1)

    def reset(self, worlds: torch.Tensor | None = None) -> None:
        """It remembers nothing."""


def drive(gain: float = 1.0, learns: bool = False, **section: Any) -> tuple[Racer, Episodes, Race]:
    """The race that a job with this ``race`` section is, of a driver that goes as told."""
    changes = race_changes({"track": "oval", **section})
    task = Racer(configured(RacerConfig, {"track": "chicane", **changes}), section.get("trials", 3), seed=5)
    laps = Laps(task)
    played = play([task], Driver(task, gain, learns), alone(), look=laps.note)
    return task, played, laps.race(played, rules_of(section), 5)


def test_a_lap_takes_as_long_as_its_control_steps_and_three_alike_take_three_times_that() -> None:
    _, played, race = drive()
    told = race.summary()
    steps = int(played.lengths[0])
    assert 0.9 * OVAL.length < 1.25 * steps / 15 < OVAL.length  # 1.25 m/s, with curves cut
    first = told["trials"][0]
    assert (first["trial"], first["status"], first["completion"]) == (1, "lap_complete", 100.0)
    assert first["steps"] == steps and first["lap_time"] == first["time"] == steps / 15
    assert (first["penalty"], first["off_tracks"], first["resets"], first["seed"]) == (0.0, 0, 0, 5)
    assert told["completed"] == 3 and told["total_time"] == pytest.approx(3 * steps / 15, rel=1e-12)
    assert told["best_lap"] == steps / 15 and told["average_lap"] == pytest.approx(steps / 15, rel=1e-12)
    assert (told["track"], told["direction"]) == (["oval"], "counter-clockwise")
    yaw = SIM_TRACE_COLUMNS.index("yaw")
    headings = [float(line.split(",")[yaw]) for line in list(race.trials[0].sim_trace(0))[1:]]
    turned = np.diff(np.unwrap(np.radians(headings))).sum()
    assert turned == pytest.approx(2 * math.pi, abs=0.2), "once round, to the left, in degrees"


def test_two_runs_of_a_race_are_the_same_bit_for_bit() -> None:
    varied = {"config": {"speed_factor": [0.8, 1.2], "randomize": {"observation_noise": {"waypoint_2_y": 0.05}}}}
    first, second = (drive(**varied)[2] for _ in range(2))
    assert json.dumps(first.summary()) == json.dumps(second.summary())
    assert all(torch.equal(one.steps, two.steps) for one, two in zip(first.trials, second.trials, strict=True))
    assert len({trial["lap_time"] for trial in first.summary()["trials"]}) > 1  # each trial has a car of its own


def test_a_trial_ends_with_its_first_mishap_where_no_car_is_put_back() -> None:
    _, played, race = drive(gain=0.0, trials=2, off_track_penalty=3.0)
    told = race.summary()
    for trial in told["trials"]:
        assert (trial["status"], trial["lap_time"]) == ("off_track", None)
        assert (trial["off_tracks"], trial["resets"], trial["penalty"]) == (1, 0, 3.0)
        assert trial["time"] == played.lengths[0].item() / 15 + 3.0
        assert 5.0 < trial["completion"] < 30.0
    assert (told["completed"], told["off_tracks"]) == (0, 2)
    assert [told[name] for name in ("total_time", "best_lap", "average_lap")] == [None] * 3


def test_penalties_count_in_a_trial_s_time_but_not_in_its_lap_time() -> None:
    _, _, race = drive(gain=0.0, learns=True, trials=1, continuous=True, off_track_penalty=2.5)
    (trial,) = race.summary()["trials"]
    assert (trial["status"], trial["off_tracks"], trial["resets"]) == ("lap_complete", 1, 1)
    assert trial["lap_time"] == trial["steps"] / 15 and trial["penalty"] == 2.5
    assert trial["time"] == trial["lap_time"] + 2.5 == race.summary()["total_time"]
    _, _, clean = drive(trials=1)
    lost = trial["steps"] / 15 - clean.summary()["best_lap"]
    assert 0.8 < lost < 2.0  # a metre or so to drive again at 1.25 m/s, from rest


@pytest.mark.parametrize(
    ("status", "section", "steps"),
    [
        ("time_out", {"seconds": 2.0}, 30),
        ("immobilized", {"config": {"speed_factor": [1e-4, 1e-4]}}, 15),
        ("time_out", {"config": {"speed_factor": [1e-4, 1e-4]}, "continuous": True, "seconds": 4.0}, 60),
        ("immobilized", {"config": {"speed_factor": [1e-4, 1e-4]}, "continuous": True, "max_resets": 2}, 45),
    ],
)
def test_the_cause_of_a_trial_s_end_is_its_status(status: str, section: dict[str, Any], steps: int) -> None:
    (trial,) = drive(trials=1, **section)[2].summary()["trials"]
    assert (trial["status"], trial["steps"], trial["lap_time"]) == (status, steps, None)
    assert trial["immobilized"] == (0 if "config" not in section else steps // 15)


def test_a_step_log_has_a_row_a_step_as_deepracer_s_tools_read_it(tmp_path: Path) -> None:
    task, played, race = drive(gain=0.0, trials=1, continuous=True, max_resets=1)
    race.write_sim_traces(tmp_path / "00000030-e1-job")
    (path,) = tmp_path.rglob("*.csv")
    there = "00000030-e1-job/sim-trace/evaluation/00000030-e1-job/evaluation-simtrace/0-iteration.csv"
    assert path == tmp_path / there
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert tuple(rows[0]) == SIM_TRACE_COLUMNS and len(rows) == 1 + int(played.lengths[0])
    start, first, last = rows[0], rows[1], rows[-1]
    expected = {"episode_status": "prepare", "steps": "0", "tstamp": "0.000", "progress": "0.0000"}
    assert start.items() >= expected.items()
    x, y = OVAL.center[0] + [0.14, 0.0]  # the front of a car on the line, on a straight along x
    assert (float(start["X"]), float(start["Y"])) == pytest.approx((x, y), abs=1e-4)
    expected = {"steps": "1", "tstamp": "0.067", "done": "False", "all_wheels_on_track": "True"}
    expected |= {"steer": "0.00", "throttle": "1.25", "action": "-1", "pause_duration": "0.00"}
    assert first.items() >= expected.items()
    assert float(first["track_len"]) == pytest.approx(OVAL.length, abs=0.005)
    statuses = [row["episode_status"] for row in rows[1:]]
    assert statuses.count("off_track") == 2 and statuses[-1] == "off_track"
    put = statuses.index("off_track") + 1
    assert [rows[put][key] for key in ("done", "all_wheels_on_track")] == ["False", "False"]
    moved = [float(rows[put + 1][axis]) - float(rows[put][axis]) for axis in "XY"]
    assert 0.9 < math.hypot(*moved) < 1.6  # back on the road, a metre along it
    assert (last["done"], last["steps"]) == ("True", str(len(rows) - 1))
    assert {float(row["yaw"]) for row in rows[1:put]} == {0.0}
    assert known(task, "tracks").tolist() == [0]


def test_a_choice_is_identified_by_its_number(tmp_path: Path) -> None:
    choices = [{"steering_angle": 0, "speed": 0.6}, {"steering_angle": 0, "speed": 1.0}]
    space = {"action_space": choices, "action_space_type": "discrete"}
    config = configured(RacerConfig, {"action_space": space, **race_changes({"seconds": 1.0})})
    task = Racer(config, 1, seed=5)
    laps = Laps(task)
    driver = Driver(task)
    driver.act = lambda observations: torch.ones(1, 1)
    race = laps.race(play([task], driver, alone(), look=laps.note), rules_of({}), 5)
    first = dict(zip(SIM_TRACE_COLUMNS, list(race.trials[0].sim_trace(0))[2].split(","), strict=True))
    last = list(race.trials[0].sim_trace(0))[-1].split(",")
    assert (first["action"], first["throttle"]) == ("1", "1.00")
    assert last[SIM_TRACE_COLUMNS.index("episode_status")] == "time_up"


def test_trials_use_the_tracks_in_turn_and_the_table_agrees_with_the_summary(tmp_path: Path) -> None:
    task, played, race = drive(trials=3, track=["oval", "chicane"], seconds=10.0)
    assert [trial.track for trial in race.trials] == ["oval", "chicane", "oval"]
    assert race.summary()["track"] == ["oval", "chicane"]
    run = Run(tmp_path / "fast")
    run.evaluations.mkdir(parents=True)
    told = result_of(task, played, "00000030-e1", 5, 0.0).write(run, "job", race)
    assert told["race"] == json.loads((run.evaluations / "00000030-e1-job.json").read_text())["race"]
    table = pyarrow.parquet.read_table(run.evaluations / told["table"]).to_pydict()
    for name, values in table.items():
        if name in told["race"]["trials"][0] and name != "seed":
            assert values == [trial[name] for trial in told["race"]["trials"]], name
    columns = {"trial", "status", "completion", "lap_time", "time", "off_tracks", "resets", "penalty", "steps"}
    assert columns <= set(table)
    assert len(list(run.evaluations.rglob("*-iteration.csv"))) == 3
    plain = result_of(task, played, "00000030-e1", 5, 0.0).write(run, "other")
    assert "compared" not in plain  # a race is compared with races
