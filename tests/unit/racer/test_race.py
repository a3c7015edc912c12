"""Races on simulated worlds: lap times, penalties, each end of a trial, step logs; cars that are put back."""

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

from racer.car.resets import COUNTS
from racer.car.task import Racer, RacerPixels
from racer.car.trace import COLUMNS
from racer.race.trials import SIM_TRACE_COLUMNS, Laps, RaceTrials
from racer.settings.task import FrontCameraConfig, ObstacleConfig, RacerConfig, RacerPixelsConfig
from racer.store.races import race_changes, rules_of
from racer.tracks.geometry import place_at, project
from shared_store.volume.layout import Run
from tests.support.racer.racing import OVAL, counted, known, racer, straight
from tests.support.worker.loop import alone
from worker.evaluation.episodes import Episodes, play
from worker.evaluation.evaluation import result_of
from worker.settings.overrides import configured


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


def drive(gain: float = 1.0, learns: bool = False, **section: Any) -> tuple[Racer, Episodes, RaceTrials]:
    """The race that a job with this ``race`` section is, of a driver with this behaviour."""
    changes = race_changes({"track": "oval", **section})
    task = Racer(configured(RacerConfig, {"track": "chicane", **changes}), section.get("trials", 3), seed=5)
    laps = Laps(task)
    played = play([task], Driver(task, gain, learns), alone(), watch=laps.note)
    return task, played, laps.race(played, rules_of(section), 5)


def test_a_lap_takes_as_long_as_its_control_steps_and_three_alike_take_three_times_that() -> None:
    _, played, race = drive()
    message = race.summary()
    steps = int(played.lengths[0])
    assert 0.9 * OVAL.length < 1.25 * steps / 15 < OVAL.length  # 1.25 m/s, with curves cut
    first = message["trials"][0]
    assert (first["trial"], first["status"], first["completion"]) == (1, "lap_complete", 100.0)
    assert first["steps"] == steps and first["lap_time"] == first["time"] == steps / 15
    assert (first["penalty"], first["off_tracks"], first["resets"], first["seed"]) == (0.0, 0, 0, 5)
    assert message["completed"] == 3 and message["total_time"] == pytest.approx(3 * steps / 15, rel=1e-12)
    assert message["best_lap"] == steps / 15 and message["average_lap"] == pytest.approx(steps / 15, rel=1e-12)
    assert (message["track"], message["direction"]) == (["oval"], "counter-clockwise")
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


def test_a_trial_ends_with_its_first_incident_where_no_car_is_put_back() -> None:
    _, played, race = drive(gain=0.0, trials=2, off_track_penalty=3.0)
    message = race.summary()
    for trial in message["trials"]:
        assert (trial["status"], trial["lap_time"]) == ("off_track", None)
        assert (trial["off_tracks"], trial["resets"], trial["penalty"]) == (1, 0, 3.0)
        assert trial["time"] == played.lengths[0].item() / 15 + 3.0
        assert 5.0 < trial["completion"] < 30.0
    assert (message["completed"], message["off_tracks"]) == (0, 2)
    assert [message[name] for name in ("total_time", "best_lap", "average_lap")] == [None] * 3


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
    race.write(tmp_path / "00000030-e1-job")
    (path,) = tmp_path.rglob("*.csv")
    present = "00000030-e1-job/sim-trace/evaluation/00000030-e1-job/evaluation-simtrace/0-iteration.csv"
    assert path == tmp_path / present
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert tuple(rows[0]) == SIM_TRACE_COLUMNS and len(rows) == 1 + int(played.lengths[0])
    start, first, last = rows[0], rows[1], rows[-1]
    expected = {"episode_status": "prepare", "steps": "0", "tstamp": "0.000", "progress": "0.0000"}
    assert start.items() >= expected.items()
    x, y = OVAL.center[0] + [0.14, 0.0]  # the front of a car on the line, on a straight along x
    assert (float(start["X"]), float(start["Y"])) == pytest.approx((x, y), abs=1e-4)
    expected = {"steps": "1", "tstamp": "0.067", "done": "False", "all_wheels_on_track": "True"}
    expected |= {"steer": "0.00", "throttle": "1.25", "action": "[0.0000 1.2500]", "pause_duration": "0.00"}
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
    race = laps.race(play([task], driver, alone(), watch=laps.note), rules_of({}), 5)
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
    message = result_of(task, played, "00000030-e1", 5, 0.0).write(run, "job", {"race": race})
    assert message["race"] == json.loads((run.evaluations / "00000030-e1-job.json").read_text())["race"]
    table = pyarrow.parquet.read_table(run.evaluations / message["table"]).to_pydict()
    for name, values in table.items():
        if name in message["race"]["trials"][0] and name != "seed":
            assert values == [trial[name] for trial in message["race"]["trials"]], name
    columns = {"trial", "status", "completion", "lap_time", "time", "off_tracks", "resets", "penalty", "steps"}
    assert columns <= set(table)
    assert len(list(run.evaluations.rglob("*-iteration.csv"))) == 3
    plain = result_of(task, played, "00000030-e1", 5, 0.0).write(run, "other")
    assert "compared" not in plain  # a race is compared with races


def continuous(worlds: int = 1, **fields: Any) -> Racer:
    return racer(worlds, track="oval", continuous=True, trace=True, **fields)


def traced(task: Racer, name: str) -> float:
    """A number of the last control step, as it was before the car was put back."""
    return float(known(task, "trace")[0, COLUMNS.index(name)])


def counts(task: Racer) -> dict[str, int]:
    return dict(zip(COUNTS, known(task, "counts")[0].tolist(), strict=True))


def until_put(task: Racer, actions: torch.Tensor, most: int = 200) -> int:
    for step in range(1, most + 1):
        task.step(actions)
        if known(task, "put")[0]:
            return step
    raise AssertionError("it was never put back")


def test_a_car_that_leaves_the_road_is_put_back_on_the_centre_line_a_metre_behind_at_rest() -> None:
    task = continuous()
    until_put(task, straight(task))
    assert not task.dones[0] and task.rewards[0] < -9  # leaving the road costs what it costs
    front = np.array([[traced(task, "x"), traced(task, "y")]])
    left = float(project(OVAL, front).along[0])
    points, headings = place_at(OVAL, [left - 1.0 - 0.14])
    pose = known(task, "poses")[0]
    np.testing.assert_allclose(pose[:2], points[0], atol=1e-4)
    assert math.cos(pose[2] - headings[0]) == pytest.approx(1.0, abs=1e-6)
    assert known(task, "speeds")[0] == known(task, "steerings")[0] == 0.0
    assert known(task, "wheels")[0] == 4
    joints = task.worlds.arrays.joint_q.numpy()[0]
    np.testing.assert_allclose(joints[:2], points[0], atol=1e-4)
    assert not task.worlds.arrays.joint_qd.numpy()[0].any()
    # what is seen is seen from there, and what is lost of the way has to be driven again
    direction = np.array([math.cos(headings[0]), math.sin(headings[0])])
    present = float(project(OVAL, points + 0.14 * direction).along[0])
    assert known(task, "travelled")[0] == pytest.approx(present - 0.14, abs=1e-3)
    (ahead,) = place_at(OVAL, [present + 0.3])[0] - points - 0.14 * direction
    column = task.observation_names.index("waypoint_0_x")
    assert task.observations[0, column].item() == pytest.approx(float(ahead @ direction), abs=1e-3)
    assert counts(task) == {"crashed": 0, "off_track": 1, "immobilized": 0, "reversed": 0, "resets": 1}


def test_progress_is_earned_once_however_often_a_car_is_put_back() -> None:
    task = continuous(rewards={"progress": 1.0, "off_track": 0.0, "crashed": 0.0}, max_resets=2)
    earned = 0.0
    while not task.dones[0]:
        task.step(straight(task))
        earned += task.rewards[0].item()
        progress = traced(task, "progress")
    assert earned == pytest.approx(progress, abs=1e-2)


def test_a_car_that_crashed_is_put_into_a_lane_without_a_box_or_on_the_centre_line_where_none_is_clear() -> None:
    task = continuous(obstacles=(ObstacleConfig(1.5, "center"),))
    steps = until_put(task, straight(task))
    along = traced(task, "x") - OVAL.center[0, 0]  # on a straight along x, from the start line
    assert 1.3 < along < 1.3 + 1.25 / 15
    # the front was on the centre line, which counts as its right
    expected = OVAL.center[0] + [along - 1.14, -0.25 * OVAL.width[0]]
    np.testing.assert_allclose(known(task, "poses")[0, :2], expected, atol=1e-3)
    assert counts(task)["crashed"] == counts(task)["resets"] == 1
    for _ in range(2 * steps):
        task.step(straight(task))
    assert counts(task)["crashed"] == 1 and known(task, "along")[0] > 1.8  # it drove past
    full = continuous(obstacles=tuple(ObstacleConfig(1.5, lane) for lane in ("inner", "center", "outer")))
    until_put(full, straight(full))
    assert known(full, "poses")[0, 1] == pytest.approx(OVAL.center[0, 1], abs=1e-4)


def test_a_car_that_stands_or_comes_back_is_put_back_after_fifteen_steps() -> None:
    stands = continuous(speed_factor=(1e-4, 1e-4))
    assert until_put(stands, straight(stands)) == 15
    assert counts(stands)["immobilized"] == 1 and known(stands, "standing")[0] == 0
    assert until_put(stands, straight(stands)) == 15
    comes_back = continuous(start_turned=(math.pi, math.pi))
    assert until_put(comes_back, straight(comes_back, -1.0)) == 15
    assert counts(comes_back)["reversed"] == 1
    assert math.cos(known(comes_back, "poses")[0, 2]) == pytest.approx(1.0, abs=1e-6)  # turned to the road
    before = known(comes_back, "along")[0]
    comes_back.step(straight(comes_back))
    assert known(comes_back, "along")[0] > before


@pytest.mark.parametrize("most", [0, 2])
def test_an_episode_ends_with_the_incident_after_the_last_reset(most: int) -> None:
    task = continuous(max_resets=most)
    steps = 0
    while not task.dones[0]:
        task.step(straight(task))
        steps += 1
    assert [traced(task, name) for name in ("off_track", "resets")] == [most + 1, most]
    assert counted(task, "termination_off_track") == counted(task, "episodes") == 1
    length = counted(task, "episode_length")
    assert length == steps
    assert counted(task, "metric_off_track") == pytest.approx(most + 1, rel=1e-5)
    assert counted(task, "metric_resets") == pytest.approx(most, rel=1e-5)
    assert counted(task, "metric_penalty") == pytest.approx(most + 1, rel=1e-5)  # of a second each
    assert counts(task) == dict.fromkeys(COUNTS, 0)  # of the next episode


def test_penalties_are_seconds_for_each_incident_of_their_kind() -> None:
    fields = {"off_track_penalty": 5.0, "crash_penalty": 2.5, "max_resets": 1}
    task = continuous(obstacles=(ObstacleConfig(1.5, "center"),), **fields)
    while not task.dones[0]:  # into the box, then past it and out of the curve
        task.step(straight(task))
    assert [traced(task, name) for name in COUNTS] == [1, 1, 0, 0, 1]
    assert counted(task, "metric_penalty") == pytest.approx(7.5, rel=1e-5)


def test_a_car_against_the_waypoints_is_put_back_against_them() -> None:
    task = continuous(alternate_direction=True, episode_seconds=20.0)
    while not known(task, "backwards")[0]:
        task.reset()
    until_put(task, straight(task))
    front = np.array([[traced(task, "x"), traced(task, "y")]])
    left = float(project(OVAL, front, np.array([True])).along[0])
    points, headings = place_at(OVAL, np.array([left - 1.14]), True)
    np.testing.assert_allclose(known(task, "poses")[0, :2], points[0], atol=1e-4)
    assert math.cos(known(task, "poses")[0, 2] - headings[0]) == pytest.approx(1.0, abs=1e-6)


def test_the_camera_of_a_car_that_was_put_back_sees_from_there() -> None:
    front = FrontCameraConfig(width=32, height=24)
    fields = {"track": "oval", "start": "line", "start_turned": (0.5, 0.5), "speed_factor": (1e-4, 1e-4)}
    task = RacerPixels(RacerPixelsConfig(continuous=True, front=front, **fields), 1, seed=3)
    images = []
    for _ in range(16):  # it stands, and turned to the left, until it is put back in the 15th step
        task.step(straight(task))
        images.append(task.groups["policy"].int().clone())
    apart = [(images[number] - images[14]).abs().float().mean().item() for number in (13, 15)]
    assert apart[1] < 0.1 < 5.0 < apart[0]
