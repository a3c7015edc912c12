"""A learner's reward function: its inputs, what the car earns, what happens where it fails or misbehaves."""

from __future__ import annotations

import dataclasses
import math
import os
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from racer.car.task import Racer, RacerPixels
from racer.rewards import parameters
from racer.rewards.problems import Failure, RewardFailed
from racer.rewards.samples import oval, samples
from racer.rewards.workers import Workers
from racer.settings.task import FrontCameraConfig, ObstacleConfig, RacerConfig, RacerPixelsConfig, RewardFile
from racer.tracks.geometry import on_road, project
from tests.support.racer.racing import known, racer, round_the_guard
from tests.support.refusals import refusal
from tests.support.waiting import wait_for

BOXES = (ObstacleConfig(1.5, "inner"), ObstacleConfig(6.0, "outer"), ObstacleConfig(9.0, "center"))
STEER = """
def reward_function(params):
    behind, ahead = params["closest_waypoints"]
    total = params["heading"] / 180 + params["waypoints"][ahead][0] - params["waypoints"][behind][1]
    for distance in params["objects_distance"]:
        if distance > params["projection_distance"]:
            total += 0.1 * params["objects_distance_from_center"][params["closest_objects"][1]]
    return total + params["speed"] * params["steps"]
"""
FAILING = "def reward_function(params):\n    return 1.0 / (params['steps'] - 7)\n"


def rewarded(text: str, worlds: int = 1, **fields: Any) -> Racer:
    return racer(
        worlds, start=fields.pop("start", "round_robin"), reward_function=RewardFile("reward.py", text), **fields
    )


def output(task: Racer, world: int) -> dict[str, Any]:
    """``params`` of a car's function in the last step."""
    race = task.sensors["race"].arrays
    numbers = race.numbers.numpy()[world].tolist()
    objects = race.objects.numpy()[world, : int(numbers[parameters.OBJECT_COUNT])].tolist()
    track = int(numbers[parameters.TRACK])
    waypoints = race.waypoints.numpy()[track, : race.counts.numpy()[track]]
    return parameters.parameters_of(numbers, objects, [(float(x), float(y)) for x, y in waypoints])


@pytest.fixture(scope="module")
def driven() -> Racer:
    """Cars on two tracks in both directions, some of them off the road."""
    starts: dict[str, Any] = {"start": "random", "start_sideways": (-0.4, 0.4), "start_turned": (-0.5, 0.5)}
    return rewarded(STEER, 24, track=("oval", "random:4"), obstacles=BOXES, alternate_direction=True, **starts)


def test_a_function_s_parameters_agree_with_the_track_s_geometry(driven: Racer) -> None:
    random, seen = torch.Generator().manual_seed(4), dict.fromkeys(("reversed", "off", "crashed", "left"), 0)
    for step in range(60):
        poses, tracks, backwards = (known(driven, name) for name in ("poses", "tracks", "backwards"))
        driven.step(torch.rand(24, 2, generator=random) * 2 - 1)
        if step % 6:
            continue
        ended = driven.dones.numpy()
        poses, commands = known(driven, "poses"), known(driven, "commands")
        for world in range(24):
            params = output(driven, world)
            if ended[world]:  # its car was placed afresh since
                seen["off"] += params["is_offtrack"]
                seen["crashed"] += params["is_crashed"]
                assert (params["progress"] < 100 and not params["all_wheels_on_track"]) or params["is_crashed"]
                continue
            track, way, (x, y, heading) = driven.circuit.tracks[tracks[world]], bool(backwards[world]), poses[world]
            forward = np.array([math.cos(heading), math.sin(heading)])
            left = np.array([-forward[1], forward[0]])
            front = np.array([x, y]) + 0.14 * forward
            found = project(track, front, way)
            wheels = [[x, y] + a * forward + b * left for a in (0.082, -0.082) for b in (0.08, -0.08)]
            on = int(on_road(track, np.array(wheels)).sum())
            assert known(driven, "wheels")[world] == on
            joints = driven.worlds.arrays.joint_q.numpy()[world, :3]
            corner = driven.circuit.corners[tracks[world]]
            np.testing.assert_allclose(joints, [*(np.array([x, y]) + corner), heading], atol=1e-5)
            steps = int(known(driven, "steps")[world])
            boxes = driven.circuit.obstacle_poses[tracks[world]]
            beside = project(track, boxes[:, :2], way)
            ways = [track.length - box.distance if way else box.distance for box in BOXES]
            gaps = [(each - float(found.along[0])) % track.length for each in ways]
            expected = {
                "all_wheels_on_track": on == 4,
                "x": front[0],
                "y": front[1],
                "heading": math.degrees(heading),
                "distance_from_center": found.distance[0],
                "is_left_of_center": bool(found.left[0]),
                "is_reversed": way,
                "is_crashed": False,
                "is_offtrack": False,
                "progress": 100 * float(known(driven, "travelled")[world]) / track.length,
                "steps": steps,
                "speed": commands[world][1],
                "steering_angle": math.degrees(commands[world][0]),
                "track_length": track.length,
                "track_width": found.width[0],
                "closest_waypoints": [int(found.before[0]), int(found.after[0])],
                "closest_objects": [int(np.argmax(gaps)), int(np.argmin(gaps))],
                "projection_distance": found.along[0],
                "sim_time": steps / 15,
                "objects_distance": ways,
                "objects_heading": [0.0] * 3,
                "objects_speed": [0.0] * 3,
                "objects_distance_from_center": beside.distance.tolist(),
            }
            for name, value in expected.items():
                assert params[name] == pytest.approx(value, abs=2e-3, rel=1e-4), (name, world, step)
            assert np.allclose(params["objects_location"], boxes[:, :2], atol=1e-5)
            assert params["objects_left_of_center"][:2] == beside.left.tolist()[:2]  # the third stands on the line
            line = np.vstack((track.center, track.center[:1]))
            assert np.allclose(params["waypoints"], line[::-1] if way else line, atol=1e-5)
            behind, ahead = (np.array(params["waypoints"][index]) for index in params["closest_waypoints"])
            assert (ahead - behind) @ [math.cos(found.heading[0]), math.sin(found.heading[0])] > 0
            assert set(params) == set(expected) | {
                "objects_location", "objects_left_of_center", "waypoints", "object_in_camera",
            }  # fmt: skip
            seen["reversed"] += way
            seen["left"] += params["is_left_of_center"]
    assert all(seen.values()), seen


@pytest.mark.parametrize(
    ("distance", "lane", "pitch", "sees"),
    [
        (2.0, "center", 0.262, True),
        (12.0, "center", 0.262, False),  # on the other side of the oval, behind the car
        (2.0, "center", 1.4, False),  # the camera looks at the road before the car
    ],
)
def test_an_object_is_in_the_camera_where_a_corner_of_it_is_in_the_image(
    distance: float, lane: Any, pitch: float, sees: bool
) -> None:
    fields = {"obstacles": (ObstacleConfig(distance, lane),), "start": "line", "track": "oval"}
    front = FrontCameraConfig(width=8, height=6, pitch=pitch)
    reward = RewardFile("reward.py", STEER)
    task = RacerPixels(RacerPixelsConfig(reward_function=reward, front=front, **fields), 1, seed=3)
    task.step(torch.zeros(1, 2))
    assert output(task, 0)["object_in_camera"] is sees


def test_a_compiled_function_earns_the_same_as_a_called_one(driven: Racer) -> None:
    config = driven.config
    assert driven.notes() == ["reward.py: compiled to the device"] and not driven.waits_for_host
    grows = STEER.replace("    total =", "    kept = []\n    kept.append(1)\n    total =")
    called = Racer(dataclasses.replace(config, reward_function=RewardFile("reward.py", grows)), 24, seed=3)
    grows = "reward.py: line 5: a list that grows: such functions run in Python workers"
    copies = "each car has its own copy of the function and of what it remembers"
    assert called.waits_for_host and called.notes() == [f"{grows}; {copies}"]
    driven.restart(3, 0)
    called.restart(3, 0)
    random = torch.Generator().manual_seed(8)
    for _ in range(40):
        actions = torch.rand(24, 2, generator=random) * 2 - 1
        for task in (driven, called):
            task.step(actions)
        torch.testing.assert_close(driven.rewards, called.rewards, rtol=2e-6, atol=1e-6)
        assert torch.equal(driven.observations, called.observations) and torch.equal(driven.dones, called.dones)
    assert driven.dones.any() or driven.statistics[0] > 0


def test_a_compiled_function_goes_on_bit_for_bit(driven: Racer) -> None:
    random = torch.Generator().manual_seed(5)
    actions = [torch.rand(24, 2, generator=random) * 2 - 1 for _ in range(20)]
    for each in actions[:10]:
        driven.step(each)
    saved = driven.state_dict()
    after = []
    for each in actions[10:]:
        driven.step(each)
        after.append(driven.rewards.clone())
    driven.restart(7, 0)
    driven.restart(3, 0)
    driven.load_state_dict(saved)
    for each, rewards in zip(actions[10:], after, strict=True):
        driven.step(each)
        assert torch.equal(driven.rewards, rewards)


def test_the_function_is_the_one_term_and_has_a_weight() -> None:
    task = rewarded("def reward_function(params):\n    return 2\n", rewards={"reward": 1.5})
    assert task.reward_terms == ("reward",) and "reward_reward" in task.statistic_names
    task.step(torch.zeros(1, 2))
    assert task.rewards.item() == 3.0
    assert tuple(Racer.config_type().rewards) == ("progress", "off_track", "crashed")
    with pytest.raises(ValueError, match=r"rewards\.progress: the task has no term 'progress'; "):
        rewarded("def reward_function(params):\n    return 2\n", rewards={"progress": 1.0})


@pytest.mark.parametrize("prefix", ["", "kept = []\n"])
def test_a_world_whose_function_fails_is_reset_and_counted(prefix: str) -> None:
    text = prefix + (FAILING.replace("    return", "    kept.append(1)\n    return") if prefix else FAILING)
    task = rewarded(text, 2, track="oval", start="line")
    assert task.failures() == {}
    for step in range(1, 9):
        task.step(torch.zeros(2, 2))
        assert task.dones.all().item() == (step == 7) and task.rewards.isfinite().all()
    (line, found), *others = task.failures().items()
    assert line.startswith("reward.py:") and "ZeroDivisionError" in line and found == (2, 0) and not others
    assert task.statistics[task.statistic_names.index("nan_worlds")] == 2
    failed_world = task.read_failed_world(int(task.failed_world))
    assert failed_world == (0, f"its reward term reward was not finite: {line}")


def test_a_function_that_never_returns_ends_the_task_with_one_line() -> None:
    body = "    kept.append(1)\n    while params['steps'] == 3:\n        pass\n    return 1.0\n"
    task = rewarded(f"kept = []\ndef reward_function(params):\n{body}", 2, start="line")
    for _ in range(2):
        task.step(torch.zeros(2, 2))
    with pytest.raises(RewardFailed, match=r"^reward\.py:[45]: car 0: the function did not return within 2 s$"):
        task.step(torch.zeros(2, 2))
    with pytest.raises(RewardFailed, match="have ended"):
        task.step(torch.zeros(2, 2))


def test_a_path_is_read_where_the_worlds_are_built(tmp_path: Path) -> None:
    missing = RacerConfig(reward_function=str(tmp_path / "no.py"))
    with pytest.raises(ValueError, match=r"^config\.reward_function: .*no\.py: .*can't be read: No such file"):
        Racer(missing, 1)
    file = tmp_path / "mine.py"
    file.write_text("def reward_function(params):\n    return None\n")
    present = r"^config\.reward_function: .*mine\.py:1: TEST_FAILURE: the sample 'start': it returned None"
    with pytest.raises(ValueError, match=present):
        Racer(RacerConfig(reward_function=str(file)), 1)
    with pytest.raises(ValueError, match="a reward function gets at most 10 objects, and there are 11"):
        RacerConfig(reward_function=str(file), obstacles=(ObstacleConfig(1.0),) * 11)


WORLDS = 9


def pool(body: str, worlds: int = WORLDS, processes: int = 2, *, unguarded: bool = False, **options: Any) -> Workers:
    """Workers of a function whose statements are ``body``; car k drives at k m/s."""
    source = "def reward_function(params):\n" + "".join(f"    {line}\n" for line in body.split("\n"))
    if unguarded:
        source = round_the_guard(source, "reward.py")
    workers = Workers(source, "reward.py", [oval()], worlds, processes, **options)
    row, objects = parameters.row_of(samples()["objects"])
    workers.numbers[:] = row
    workers.objects[:, : len(objects)] = objects
    workers.numbers[:, parameters.NUMBER_COLUMNS["speed"]] = range(worlds)
    return workers


def test_the_dictionary_has_every_documented_key_with_its_type() -> None:
    checks = [
        f"type(params[{each.name!r}]) is {each.kind}" if each.shape == "one" else f"type(params[{each.name!r}]) is list"
        for each in parameters.PARAMETERS
    ]
    elements = "type(params['waypoints'][0]) is tuple and type(params['objects_left_of_center'][0]) is bool"
    with pool(f"return float({' and '.join([*checks, elements])})") as workers:
        assert workers.rewards().tolist() == [1.0] * WORLDS


def test_a_function_that_changes_its_parameters_changes_nothing_for_others() -> None:
    with pool("params['waypoints'].clear()\nparams['speed'] = -1\nreturn float(len(params))") as workers:
        first = workers.rewards().tolist()
        assert workers.rewards().tolist() == first == [float(len(parameters.PARAMETERS))] * WORLDS
    with pool("n = len(params['waypoints'])\nparams['waypoints'].clear()\nreturn n") as workers:
        assert workers.rewards().tolist() == workers.rewards().tolist() == [float(len(oval()))] * WORLDS


RANGE = "a reward is from -100,000 to 100,000, as on AWS"
NONE = "reward.py: it returned None; return a number on every way through the function"


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ("return 1 / (params['speed'] - 3)", "reward.py:2: ZeroDivisionError: float division by zero"),
        ("return None if params['speed'] == 3 else 1", NONE),
        ("return float('nan') if params['speed'] == 3 else 1", "reward.py: it returned nan; return a finite number"),
        ("return 'much' if params['speed'] == 3 else 1", "reward.py: it returned a str; return a number"),
        ("return 100001 if params['speed'] == 3 else -1e5", f"reward.py: it returned 100001; {RANGE}"),
        ("return 1e9 * params['speed'] if params['speed'] == 3 else 1", f"reward.py: it returned 3e+09; {RANGE}"),
        ("if params['speed'] == 3: [0] * 10**9\nreturn 1", "reward.py:2: it used more than 2 GiB of memory"),
        ("if params['speed'] == 3: raise SystemExit\nreturn 1", "reward.py:2: it ended the program (SystemExit)"),
    ],
)
def test_a_call_that_gives_no_number_is_nan_and_counted_and_the_others_go_on(body: str, message: str) -> None:
    with pool(body) as workers:
        for steps in (1, 2):
            assert np.isnan(workers.rewards()).tolist() == [car == 3 for car in range(WORLDS)]
            assert workers.failures == {message: Failure(steps, car=3)}


LATE, FLOOD = "the function did not return within 0.3 s", "the function printed more than 64 KiB of text in one call"
CATCHING = "while params['speed'] == 7:\n    try:\n        while True: pass\n    except BaseException: pass\nreturn 1"
PRINTING = "for i in range(1_000_000 if params['speed'] == 7 else 3):\n    print(i)\nreturn 1"


@pytest.mark.parametrize(
    ("body", "line", "message"),
    [("while params['speed'] == 7: pass\nreturn 1", 2, LATE), (CATCHING, 4, LATE), (PRINTING, 3, FLOOD)],
)
def test_a_call_that_does_not_end_or_floods_ends_the_pool_with_its_line_and_car(
    body: str, line: int, message: str
) -> None:
    workers = pool(body, seconds=0.3)
    processes = list(workers.processes)
    assert refusal(workers.rewards, error=RewardFailed) == f"reward.py:{line}: car 7: {message}"
    assert all(process.returncode is not None for process in processes)
    with pytest.raises(RewardFailed, match="have ended"):
        workers.rewards()


def test_a_process_that_dies_is_reported_with_its_cars() -> None:
    workers = pool("return 1.0")
    workers.processes[1].kill()
    with pytest.raises(RewardFailed, match=r"reward.py: cars 5 to 8: the process of the function ended \(signal 9\)"):
        workers.rewards()


def test_a_file_that_cannot_be_loaded_is_reported_at_the_start() -> None:
    with pytest.raises(RewardFailed, match=r"^reward.py:1: ZeroDivisionError: division by zero$"):
        Workers("A = 1 / 0\ndef reward_function(params):\n    return 1.0\n", "reward.py", [oval()], 2, 1)


def test_a_worker_keeps_no_file_and_starts_no_process(tmp_path: Path) -> None:
    writes = f"open({str(tmp_path / 'kept')!r}, 'w').write('text' * 5000)\nreturn 1.0"
    with pool(writes, 1, 1, unguarded=True) as workers:
        assert math.isnan(workers.rewards()[0])
        denied = f"PermissionError: [Errno 1] Operation not permitted: {str(tmp_path / 'kept')!r}"
        assert list(workers.failures) == [f"reward.py:2: {denied}"]
    assert not (tmp_path / "kept").exists()


def test_workers_end_with_the_process_that_started_them() -> None:
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        workers = pool("return 1.0", 2, 1)
        os.write(writer, f"{workers.processes[0].pid}\n".encode())
        time.sleep(600)
    os.close(writer)
    with os.fdopen(reader) as answer:
        worker = int(answer.readline())
    os.kill(child, 9)
    os.waitpid(child, 0)
    wait_for(lambda: not Path(f"/proc/{worker}").exists() or _ended(worker), 30, "the worker's end")


def _ended(process: int) -> bool:
    try:
        return Path(f"/proc/{process}/stat").read_text().split(") ")[1].startswith("Z")
    except OSError:
        return True
