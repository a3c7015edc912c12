"""Cars that are put back: where, at what price, how often, and what ends an episode then."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch

from tests.support.worker.racing import OVAL, counted, known, racer, straight
from worker.racer.geometry import place_at, project
from worker.racer.resets import COUNTS
from worker.racer.trace import COLUMNS
from worker.tasks.configs.racer import FrontCameraConfig, ObstacleConfig, RacerPixelsConfig
from worker.tasks.racer import Racer, RacerPixels


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
    there = float(project(OVAL, points + 0.14 * direction).along[0])
    assert known(task, "travelled")[0] == pytest.approx(there - 0.14, abs=1e-3)
    (ahead,) = place_at(OVAL, [there + 0.3])[0] - points - 0.14 * direction
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
def test_an_episode_ends_with_the_mishap_after_the_last_reset(most: int) -> None:
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


def test_penalties_are_seconds_for_each_mishap_of_their_kind() -> None:
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


def test_worlds_that_were_put_back_go_on_bit_for_bit_from_their_state() -> None:
    first, second = (continuous(2, start="round_robin", max_resets=3) for _ in range(2))
    for _ in range(60):
        first.step(straight(first))
    assert known(first, "counts")[:, COUNTS.index("resets")].any()
    second.load_state_dict(first.state_dict())
    for _ in range(60):
        for task in (first, second):
            task.step(straight(task))
        assert torch.equal(first.observations, second.observations) and torch.equal(first.dones, second.dones)
    assert (known(first, "counts") == known(second, "counts")).all()


def test_without_resets_a_mishap_ends_the_episode_and_is_counted_once() -> None:
    task = racer(track="oval", trace=True)
    while not task.dones[0]:
        task.step(straight(task))
    assert [traced(task, name) for name in COUNTS] == [0, 1, 0, 0, 0]
    assert "metric_resets" not in task.statistic_names
    assert not {name for name in task.state_tensors() if "counts" in name}


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
