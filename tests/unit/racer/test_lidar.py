"""The car's lidar: its rays against those of numpy, what its forms are, and which sensors of DeepRacer it stands for."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from orchestrator.domain.errors import SpecError
from orchestrator.spec.model import validate
from racer.car.car_arrays import CarArrays
from racer.car.task import Racer, RacerPixelsAndState
from racer.settings.task import LidarConfig, ObstacleConfig, RacerConfig, RacerPixelsAndStateConfig
from racer.tracks.circuit import BOX

BOXES = tuple(ObstacleConfig(float(along), lane) for along in range(1, 17) for lane in ("inner", "outer"))
FIVE = [{"steering_angle": angle, "speed": 0.6} for angle in (30, 0, -30)]


def seen(task: Racer) -> np.ndarray:
    columns = [number for number, name in enumerate(task.observation_names) if name.startswith("lidar")]
    assert columns == list(range(columns[0], columns[0] + task.lidar.size))
    return task.observations[:, columns].numpy()


def distance(start: np.ndarray, angle: float, boxes: np.ndarray) -> float:
    """To the nearest side of a box that a ray meets [m], by the sides' own equations; 0 where it begins in one."""
    way, found = np.array([math.cos(angle), math.sin(angle)]), math.inf
    for x, y, heading in boxes:
        turn = np.array([[math.cos(heading), -math.sin(heading)], [math.sin(heading), math.cos(heading)]])
        half = np.array([BOX[0], BOX[1]]) / 2
        if (np.abs(turn.T @ (start - [x, y])) <= half).all():
            return 0.0
        corners = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * half @ turn.T + [x, y]
        for begin, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
            system = np.stack((way, begin - end), 1)
            if abs(np.linalg.det(system)) > 1e-12:
                along, share = np.linalg.solve(system, begin - start)
                if along >= 0 and 0 <= share <= 1:
                    found = min(found, along)
    return found


def expected(task: Racer, lidar: LidarConfig) -> np.ndarray:
    """The nearest distance in each sector of each world, inf where there is none."""
    car: CarArrays = task.sensors["car"].arrays
    boxes, poses = car.obstacle_poses.numpy()[0], car.poses.numpy()
    rays = lidar.sectors * lidar.rays
    angles = lidar.field * ((np.arange(rays) + 0.5) / rays - 0.5)
    found = [[distance(pose[:2], pose[2] + angle, boxes) for angle in angles] for pose in poses.astype(float)]
    return np.array(found).reshape(len(poses), lidar.sectors, lidar.rays).min(axis=2)


def racer(lidar: LidarConfig, worlds: int = 16) -> Racer:
    starts: dict[str, Any] = {"start": "random", "start_sideways": (-0.5, 0.5), "start_turned": (-3.0, 3.0)}
    return Racer(RacerConfig(obstacles=BOXES, lidar=lidar, track="oval", **starts), worlds, seed=5)


def test_every_sector_sees_the_nearest_obstacle_that_numpy_computes() -> None:
    lidar = LidarConfig(sectors=6, rays=3, range=2.0, field=2.5)
    task = racer(lidar)
    distances = expected(task, lidar)
    assert (distances == 0).any() and np.isinf(distances).any() and ((distances > 0.15) & (distances < 2)).sum() > 20
    np.testing.assert_allclose(seen(task), np.clip(distances, 0.15, 2.0), atol=1e-4)


def test_levels_mark_the_part_of_the_range_that_holds_the_nearest_obstacle() -> None:
    lidar = LidarConfig(sectors=16, rays=1, levels=3, least=0.2, range=1.4)
    task = racer(lidar)
    distances = expected(task, lidar)
    parts = np.clip((np.clip(distances, 0.2, 1.4) - 0.2) / 0.4, 0, 2.999).astype(int)
    levels = np.eye(3)[parts] * (distances <= 1.4)[:, :, None]
    assert (levels.sum(axis=(0, 1)) > 3).all() and (distances > 1.4).any()
    np.testing.assert_array_equal(seen(task), levels.reshape(len(levels), -1))


@pytest.mark.parametrize(("sensor", "size"), [("LIDAR", 64), ("SECTOR_LIDAR", 8), ("DISCRETIZED_SECTOR_LIDAR", 64)])
def test_a_lidar_among_deepracer_s_sensors_becomes_the_task_s_lidar(sensor: str, size: int) -> None:
    space = {"action_space": FIVE, "sensor": ["FRONT_FACING_CAMERA", sensor]}
    config = RacerPixelsAndStateConfig(action_space=space)
    lidar = config.lidar_of(config.actions())
    assert lidar is not None and lidar.size == size
    if sensor == "SECTOR_LIDAR":
        task = RacerPixelsAndState(config, 1, seed=1)
        assert task.observation_names == ("speed", "steering", *(f"lidar_{sector}" for sector in range(8)))
        assert task.observations[0, 2:].tolist() == [0.0] * 8  # there is no obstacle


def sensing(*sensors: str) -> dict[str, Any]:
    return {"action_space": {"action_space": FIVE, "sensor": [*sensors]}}


BLIND = "the policy of this task sees an image alone; use task RacerPixelsAndState"
TWO = "lidar: the action space has the sensor LIDAR, too; leave one of them out"
BOTH = "action_space.sensor: a car has one lidar, and there are LIDAR and SECTOR_LIDAR"


@pytest.mark.parametrize(
    ("task", "config", "words"),
    [
        ("Racer", {"lidar": {"sector": 8}}, "lidar.sector: "),
        ("Racer", {"lidar": {"sectors": 0}}, "lidar.sectors: expected a value greater than or equal to 1, found 0"),
        ("Racer", {"lidar": {"least": 1.0}}, "lidar.least: expected less than range (1), found 1"),
        ("Racer", {"lidar": 3}, "lidar: "),
        ("RacerPixels", {"lidar": {}}, f"lidar: {BLIND}"),
        ("RacerPixels", sensing("LIDAR"), f"action_space.sensor: {BLIND}"),
        ("Racer", {**sensing("LIDAR"), "lidar": {}}, TWO),
        ("Racer", sensing("LIDAR", "SECTOR_LIDAR"), BOTH),
    ],
)
def test_an_impossible_lidar_is_refused_in_one_line(task: str, config: dict[str, Any], words: str) -> None:
    with pytest.raises(SpecError) as found:
        validate({"name": "x", "train": {"task": task, "worlds": 1, "iterations": 1, "config": config}}, "x.yaml")
    assert str(found.value).startswith(f"x.yaml: train.config.{words}") and "\n" not in str(found.value)
