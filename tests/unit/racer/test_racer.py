"""The racer's tasks: laps, the ends of episodes, starts, obstacles, tracks, actions and images."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch

from orchestrator.spec.model import validate
from racer.car.task import Racer, RacerPixels, RacerPixelsAndState
from racer.settings.task import FrontCameraConfig, ObstacleConfig, RacerConfig, RacerPixelsConfig
from racer.tracks.geometry import on_road, place_at
from tests.support.racer.racing import OVAL, ahead, counted, known, racer, straight
from tests.support.refusals import refusal
from worker.learning.job import configure
from worker.learning.report import figures_of, shown_of
from worker.settings.errors import UserError
from worker.tasks.run.policy_contract import policy_contract

FIVE = [{"steering_angle": angle, "speed": 0.6} for angle in (30, 15, 0, -15, -30)]
DISCRETE = {"action_space": FIVE, "action_space_type": "discrete", "sensor": ["FRONT_FACING_CAMERA"], "version": "5"}


def test_a_car_that_steers_for_the_road_ahead_completes_a_lap() -> None:
    task = racer(2, track="oval")
    rewards, steps = torch.zeros(2), 0
    while not task.dones.any():
        task.step(ahead(task))
        rewards += task.rewards
        steps += 1
    assert task.dones.all() and not task.time_outs.any()
    assert counted(task, "termination_lap_complete") == 2
    assert rewards.numpy() == pytest.approx(100.0, abs=1.0)  # percent, and the rest of the last step
    assert 0.9 * OVAL.length < 1.25 * steps / 15 < OVAL.length  # 1.25 m/s, with curves cut
    assert counted(task, "metric_progress") == 2 * 100.0
    assert counted(task, "metric_lap_time") == pytest.approx(2 * steps / 15, rel=1e-6)
    assert task.ended.terms[:, task.ended.columns.index("metric_progress")].tolist() == [100.0, 100.0]


def test_an_episode_ends_when_no_wheel_is_on_the_road_any_more() -> None:
    task = racer(track="oval")
    while not task.dones.any():
        assert known(task, "wheels")[0] > 0
        pose = known(task, "poses")[0]
        reward = task.rewards[0].item()
        task.step(straight(task))
    assert counted(task, "termination_off_track") == counted(task, "episodes") == 1
    assert task.rewards[0].item() < -9 < reward
    assert abs(pose[1] - OVAL.center[0, 1]) < 0.5  # straight on, out of the first curve
    assert not on_road(OVAL, pose[None, :2] + [0.25, 0.0]).any()


@pytest.mark.parametrize(
    ("end", "speed", "fields"),
    [
        ("immobilized", 0.0, {"speed_factor": (1e-4, 1e-4)}),
        ("reversed", -1.0, {"start_turned": (math.pi, math.pi)}),
        ("time_out", 0.0, {"episode_seconds": 1.0}),
    ],
)
def test_a_car_that_stands_or_comes_back_or_has_no_time_left_ends_its_episode_in_the_fifteenth_step(
    end: str, speed: float, fields: dict[str, Any]
) -> None:
    task = racer(track="oval", **fields)
    for step in range(1, 16):
        task.step(straight(task, speed))
        assert task.dones[0].item() == (step == 15) and (end != "reversed" or task.rewards[0] < 0)
    assert counted(task, f"termination_{end}") == 1 and task.time_outs[0].item() == (end == "time_out")


def test_a_car_that_touches_an_obstacle_has_crashed() -> None:
    task = racer(track="oval", obstacles=(ObstacleConfig(1.5, "center"),))
    column = task.observation_names.index("obstacle_ahead")
    assert task.observations[0, column : column + 2].numpy() == pytest.approx([1.5 - 0.14, 0.0], abs=1e-4)
    while not task.dones.any():
        along = known(task, "along")[0]
        assert along < 1.3 and not known(task, "crashed")[0]  # the front of the box
        task.step(straight(task))
    assert counted(task, "termination_crashed") == 1 and along > 1.3 - 1.25 / 15
    beside = racer(track="oval", obstacles=(ObstacleConfig(1.5, "inner"),))
    for _ in range(35):
        beside.step(straight(beside))
    assert known(beside, "along")[0] > 1.8 and counted(beside, "episodes") == 0
    assert known(beside, "next_obstacle")[0] == known(beside, "last_obstacle")[0] == 0
    assert beside.observations[0, column].item() == 4.0  # it lies behind


def test_starts_go_round_the_track_and_turn_round() -> None:
    task = racer(3, track="oval", start="round_robin", alternate_direction=True, episode_seconds=1 / 15)
    for episode in range(1, 4):  # one was begun before a seed was set
        before = known(task, "poses")
        backwards = known(task, "backwards")
        assert len(set(backwards.tolist())) == 1
        shares = [0.05 * (world + episode - 1) for world in range(3)]
        points, headings = place_at(OVAL, OVAL.length * np.array(shares), bool(backwards[0]))
        np.testing.assert_allclose(before[:, :2], points, atol=1e-4)
        np.testing.assert_allclose(np.cos(before[:, 2] - headings), 1.0, atol=1e-4)
        task.step(straight(task))
        assert (known(task, "backwards") != backwards).all()


def test_controls_arrive_as_late_as_the_latency_says() -> None:
    task = racer(64, track="oval", randomize={"action_latency": 3})
    arrived = np.full(64, -1)
    task.step(-torch.ones(64, 2))
    assert (known(task, "commands")[:, 1] == 0.5).all()  # there are none before the first ones
    for step in range(5):
        task.step(torch.ones(64, 2))
        arrived[(arrived < 0) & (known(task, "commands")[:, 1] == 2.0)] = step
    assert set(arrived.tolist()) == {0, 1, 2, 3}


def test_factors_and_offsets_change_the_car_s_response() -> None:
    fields = {"speed_factor": (0.5, 0.6), "steering_factor": (1.2, 1.4), "steering_offset": (0.1, 0.2)}
    task = racer(64, track="oval", speed_lag=0.0, steering_lag=0.0, **fields)
    task.step(torch.tensor([[0.5, 1.0]] * 64))
    speeds, steerings = known(task, "speeds") / 2.0, known(task, "steerings")
    assert 0.5 <= speeds.min() < 0.52 and 0.58 < speeds.max() <= 0.6
    assert 0.1 + 1.2 * 0.2618 <= steerings.min() < steerings.max() <= 0.2 + 1.4 * 0.2618 + 1e-4


def test_friction_bounds_how_fast_the_car_turns() -> None:
    """At 2 m/s and 30 degrees a car that never slides turns by 7.0 rad/s; tyres of 0.4 to 0.6 bear half of that, and are drawn for each episode."""
    turned = []
    for friction in ((0.0, 0.0), (0.4, 0.6)):
        task = racer(64, track="oval", speed_lag=0.0, steering_lag=0.0, friction=friction)
        before = known(task, "poses")[:, 2]
        task.step(torch.tensor([[1.0, 1.0]] * 64))
        turned.append((known(task, "poses")[:, 2] - before) * 15.0)
    np.testing.assert_allclose(turned[0], 2.0 * math.tan(math.pi / 6) / 0.164, rtol=1e-4)
    bounds = [9.81 * coefficient / 2.0 for coefficient in (0.4, 0.6)]
    assert bounds[0] - 1e-3 <= turned[1].min() < 2.1 and 2.8 < turned[1].max() <= bounds[1] + 1e-3
    slow = racer(1, track="oval", speed_lag=0.0, steering_lag=0.0, friction=(0.5, 0.5))
    slow.step(torch.tensor([[0.2, -1.0]]))  # 0.5 m/s and 6 degrees: nothing slides
    free = racer(1, track="oval", speed_lag=0.0, steering_lag=0.0)
    free.step(torch.tensor([[0.2, -1.0]]))
    np.testing.assert_array_equal(known(slow, "poses"), known(free, "poses"))


def test_choices_are_those_of_the_metadata() -> None:
    task = racer(5, track="oval", action_space=DISCRETE)
    assert task.discrete and task.action_names[0] == "0: 30 degrees, 0.6 m/s" and task.actions.shape == (5, 1)
    task.step(torch.arange(5.0)[:, None])
    request = [(math.radians(each["steering_angle"]), each["speed"]) for each in FIVE]
    np.testing.assert_allclose(known(task, "commands"), request, atol=1e-6)
    assert policy_contract(task, "Racer").discrete


def test_continuous_actions_reach_from_end_to_end() -> None:
    space = {"steering_angle": {"low": -20, "high": 30}, "speed": {"low": "1", "high": 3}}
    task = racer(3, track="oval", action_space={"action_space": space})
    task.step(torch.tensor([[-1.0, -1.0], [1.0, 1.0], [9.0, 0.0]]))
    expected = [[math.radians(-20), 1.0], [math.radians(30), 3.0], [math.radians(30), 2.0]]
    np.testing.assert_allclose(known(task, "commands"), expected, atol=1e-6)
    steering, speed = policy_contract(task, "Racer").actions
    assert (steering.name, steering.unit, speed.name, speed.unit) == ("steering", "rad", "speed", "m/s")
    assert (speed.scale, speed.offset) == (1.0, 2.0)


def space(actions: Any, **more: Any) -> dict[str, Any]:
    return {"action_space": {"action_space": actions, **more}}


STILL, SPEEDS, LOW = {"steering_angle": 0, "speed": 1}, {"low": 1, "high": 2}, "config.action_space.action_space"
LEFT, TURNING = {"distance": 1.0, "lane": "left"}, {"steering_angle": {"low": 9, "high": 9}}
REFUSED: dict[str, dict[str, Any]] = {
    f"{LOW}.1.speed: expected a number [m/s], found 'fast'": space([STILL, {**STILL, "speed": "fast"}]),
    f"{LOW}.0.steering_angle: expected a number [degrees], found inf": space(
        [{**STILL, "steering_angle": math.inf}] * 2
    ),
    f"{LOW}: expected a list of 2 to 30 actions, found 1, which AWS refuses, too": space([STILL]),
    f"{LOW}: expected a list of 2 to 30 actions, found 31, which AWS refuses, too": {"action_space": [STILL] * 31},
    f"{LOW}.speed: low is 5 and high is 6; the car's range is 0.1 to 4 m/s": space(
        {"steering_angle": {"low": -30, "high": 30}, "speed": {"low": 5, "high": 6}}
    ),
    "config.action_space: expected the path or the content of a model_metadata.json, found 5": {"action_space": 5},
    f"{LOW}.steering_angle: low is 9 and high is 9; low must be less": space({**TURNING, "speed": SPEEDS}),
    f"{LOW}_type: there is no type 'discreet'; did you mean discrete?": space(FIVE, action_space_type="discreet"),
    f"{LOW}_type: it is continuous, and action_space is a list of actions; they must fit": space(
        FIVE, action_space_type="continuous"
    ),
    "config.action_space.sensor.0: DeepRacer knows no sensor 'RADAR'; use FRONT_FACING_CAMERA, LIDAR, SECTOR_LIDAR, "
    "DISCRETIZED_SECTOR_LIDAR": space(FIVE, sensor=["RADAR"]),
    "config.action_space.sensor: a car has one camera, and there are STEREO_CAMERAS and LEFT_CAMERA": space(
        FIVE, sensor=["STEREO_CAMERAS", "LEFT_CAMERA"]
    ),
    f"{LOW}.0: there is no key 'steering'; did you mean steering_angle?": space([{"steering": 0, "speed": 1}] * 2),
    "config.obstacles.0.lane: expected 'inner', 'center' or 'outer', found 'left'": {"obstacles": [LEFT]},
    "config.randomize.mass: the car moves as a kinematic bicycle, without an engine's contacts; use "
    "train.config.speed_factor, steering_factor and steering_offset": {"randomize": {"mass": [0.5, 2]}},
    "config.randomize.push_interval: nothing can push a car that moves as a kinematic bicycle": {
        "randomize": {"push_interval": 1.0, "push_velocity": 1.0}
    },
}


@pytest.mark.parametrize("message", REFUSED)
def test_an_impossible_car_is_refused_in_one_line_before_anything_is_built(message: str) -> None:
    assert refusal(configure, Racer, {"config": REFUSED[message]}, error=UserError).removeprefix("train.") == message


def noted(space: Any, algorithm: str = "ppo") -> list[str]:
    train = {"task": "Racer", "worlds": 8, "iterations": 1, "algorithm": algorithm, "config": {"action_space": space}}
    return list(validate({"name": "racer", "train": train}, "racer.yaml").notes)


def test_actions_out_of_the_car_s_range_are_clipped_as_aws_s_simulator_does_with_a_note_for_each_kind() -> None:
    wild = [(45, 5), (-30, "8"), (0, 0.05), ("-31.5", 4), (30, 0.1)]
    request = [{"steering_angle": angle, "speed": speed, "index": number} for number, (angle, speed) in enumerate(wild)]
    request[0]["name"] = "left"  # nor does AWS look at it
    clipped = ((30.0, 4.0), (-30.0, 4.0), (0.0, 0.1), (-30.0, 4.0), (30.0, 0.1))
    for content in (request, {"action_space": request}):  # older files hold the list alone
        config = RacerConfig(action_space=content)
        assert config.actions().choices == clipped
        assert noted(content) == [
            "action_space: 2 actions have a steering angle beyond 30 degrees and steer 30",
            "action_space: 2 actions have a speed above 4 m/s and drive 4",
            "action_space: 1 action has a speed below 0.1 m/s and drives 0.1",
        ]
    kept = Racer.sketch(config).bundle_documents("ppo")["model_metadata.json"]["action_space"]
    assert tuple((action["steering_angle"], action["speed"]) for action in kept) == clipped
    ranges = {"steering_angle": {"low": "-45", "high": 30}, "speed": {"low": 0.1, "high": 9}}
    space = RacerConfig(action_space={"action_space": ranges}).actions()
    assert (space.steering, space.speed) == ((-30.0, 30.0), (0.1, 4.0))
    assert noted({"action_space": ranges}) == [
        "action_space: steering_angle.low is -45 degrees, out of the car's range, and becomes -30",
        "action_space: speed.high is 9 m/s, out of the car's range, and becomes 4",
    ]
    assert noted(DISCRETE) == []


def test_a_camera_or_an_algorithm_of_a_metadata_file_that_the_job_does_not_have_is_noted() -> None:
    for sensor, more in (
        ("STEREO_CAMERAS", "; its policy sees no depth from two images"),
        ("LEFT_CAMERA", ", in its middle"),
    ):
        assert noted({**DISCRETE, "sensor": ["LIDAR", sensor]}) == [
            f"action_space: the simulated car has one front camera in the place of {sensor}{more}"
        ]
        config = RacerConfig(action_space={**DISCRETE, "sensor": ["LIDAR", sensor]})
        assert Racer.sketch(config).bundle_documents("ppo")["model_metadata.json"]["sensor"] == ["LIDAR"]
    sac = {"action_space": {"steering_angle": {"low": -9, "high": 9}, "speed": SPEEDS}, "training_algorithm": " SAC "}
    assert noted(sac, "sac") == noted({**sac, "training_algorithm": "clipped_ppo"}) == []
    assert noted(sac) == ["action_space: its training_algorithm is sac, and train.algorithm is ppo"]


def test_errors_that_only_a_rank_can_see_are_refused_in_one_line(tmp_path: Any) -> None:
    for fields, message in (
        ({"track": "ovall"}, "config.track: track 'ovall': there is no such track; did you mean oval?"),
        ({"action_space": f"{tmp_path}/none.json"}, f"config.{tmp_path}/none.json: it can't be read (No such file"),
        (
            {"obstacles": (ObstacleConfig(20.5),), "track": "oval"},
            "config.obstacles.0.distance: 20.5 m is beyond the end of track oval, which is 20.00 m long",
        ),
    ):
        assert message in refusal(Racer.sketch, RacerConfig(**fields))
    (tmp_path / "model_metadata.json").write_text('{"action_space": [')
    with pytest.raises(ValueError, match="it is not JSON"):
        RacerConfig(action_space=str(tmp_path / "model_metadata.json")).actions()


def test_a_camera_sees_grass_asphalt_border_and_boxes_and_every_world_its_own() -> None:
    front = FrontCameraConfig(width=64, height=48, kind="color")
    boxes = (ObstacleConfig(1.2, "outer"),)
    fields: dict[str, Any] = {"track": "oval", "front": front, "obstacles": boxes}
    plain = RacerPixels(RacerPixelsConfig(**fields), 4, seed=1)
    images = plain.observations.permute(0, 2, 3, 1).int()
    assert plain.observations.shape == (4, 3, 48, 64) and plain.observations.dtype == torch.uint8
    red, green, blue = images[0].unbind(-1)
    seen = {
        "grass": (green > 1.5 * red) & (green > 1.5 * blue),
        "asphalt": (red < 80) & ((red - green).abs() < 10) & ((blue - green).abs() < 20),
        "border": (red > 180) & (green > 180) & (blue > 180),
        "box": (red > 2 * green) & (red > 2 * blue),
        "dashes": (red > 150) & (green > 100) & (blue < 80),
    }
    shares = {name: where.float().mean().item() for name, where in seen.items()}
    assert min(shares.values()) > 0.002, shares
    assert shares["asphalt"] > 0.2 and seen["grass"][:9].sum() == 0  # sky above
    assert (images[0] != images[3]).any()  # 5 % of the track farther each

    different = {"light": (0.5, 1.0), "colors": 0.2, "camera_angle": 0.05}
    drawn = RacerPixels(RacerPixelsConfig(**fields, start="line", randomize=different), 4, seed=1)
    assert len({bytes(image.numpy()) for image in drawn.observations}) == 4
    plain.step(straight(plain))
    assert (plain.observations.permute(0, 2, 3, 1).int() != images).any()


def test_an_image_and_numbers_are_groups_of_their_own() -> None:
    sketch = RacerPixelsAndState.sketch(RacerPixelsAndState.config_type())
    assert sketch.observation_names == ("speed", "steering") and sketch.plan.images == {"front": "front"}
    assert len(sketch.plan.groups["critic"]) == 6


def test_a_policy_means_the_same_on_another_track_and_by_other_rules() -> None:
    here = racer(track="oval")
    present = racer(track=("chicane", "random:3"), continuous=True, trace=True, speed_lag=0.1)
    assert policy_contract(here, "Racer") == policy_contract(present, "Racer")


def test_a_bundle_has_the_actions_and_the_sensors_as_deepracer_names_them() -> None:
    task = racer(action_space={**DISCRETE, "sensor": ["SECTOR_LIDAR"]})
    found = task.bundle_documents("ppo")["model_metadata.json"]
    assert found == {**DISCRETE, "sensor": ["SECTOR_LIDAR"], "training_algorithm": "clipped_ppo"}
    again = racer(action_space=found)  # it is an action space for the next training, too
    assert again.actions_of_car == task.actions_of_car
    usual = racer().bundle_documents("mine:Algorithm")["model_metadata.json"]
    ranges = {"steering_angle": {"low": -30, "high": 30}, "speed": {"low": 0.5, "high": 2.0}}
    assert usual == {"action_space": ranges, "action_space_type": "continuous", "sensor": [], "version": "5"}


def test_a_training_of_a_racer_shows_the_mean_progress_of_its_episodes() -> None:
    task = racer(2, track="oval")
    assert task.shown_metrics == {"metric_progress": "%"}
    # a lap of 300 steps and an exit after 20 steps and a tenth of the track: 55 %, not what 320 steps in the mean would say
    figures = figures_of({"metric_progress": 110.0, "metric_other": 32.0}, 2, 320, task.final_metrics)
    assert figures == {"metric_progress": 55.0, "metric_other": 0.1}
    assert shown_of(figures, task.shown_metrics) == {"shown": {"progress": "55.0 %"}}
    none = figures_of({"metric_progress": 0.0}, 0, 0, task.final_metrics)
    assert shown_of(none, task.shown_metrics) == {"shown": {"progress": "- %"}}
