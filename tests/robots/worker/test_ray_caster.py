"""Rays against MuJoCo's own: patterns, what the frame turns with, and what is refused."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
import pytest
import torch

from tests.support.refusals import refusal
from tests.support.worker.declared import Small, SmallConfig
from tests.support.worker.sensing import Reference, scene
from worker.simulation.sensors.height_scan import GridPattern
from worker.simulation.sensors.rays import LidarPattern, RayCaster, RayCasting
from worker.simulation.sensors.sensor import SensorContext
from worker.tasks import Box, Event, Observation, Reward, reward_weights, terms

ARM = """<mujoco><worldbody>{ground}
  <geom name="wall" type="box" size="0.05 3 3" pos="6 0 0"/><geom name="ball" type="sphere" size="0.4" pos="0 -2 1.1"/>
  <body name="arm" pos="0 0 1"><joint name="turn" axis="0 0 1"/><joint name="lift" axis="0 1 0"/>
    <geom name="arm" type="capsule" fromto="0 0 0 0.3 0 0" size="0.04" mass="1"/>
    <site name="eye" pos="0.5 0.05 0.1" euler="10 -20 30"/></body></worldbody>
  <actuator><motor name="turn" joint="turn"/><motor name="lift" joint="lift"/></actuator></mujoco>"""
ANGLES = ((0.2, 0.1), (-0.9, 0.35))
FAR = 8.0


@pytest.fixture(scope="module")
def context() -> SensorContext:
    """Two worlds of an arm, a wall and a ball of its file above a plane."""
    made = scene({"robot": ARM.format(ground="")}, ground=True)
    positions = made.worlds.arrays.joint_q.numpy()
    positions[:, made.views["robot"].coordinates] = ANGLES
    made.worlds.arrays.joint_q.assign(positions)
    made.worlds.update_bodies()
    made.worlds.update_shapes()
    return made


def cast(context: SensorContext, **options: Any) -> tuple[RayCasting, np.ndarray]:
    """The rays of both worlds and their distances."""
    built = RayCaster(max_distance=FAR, **options).build(context)
    built.settle()
    return built, built.arrays.distances.numpy()


def reported(world: int, origins: np.ndarray, directions: np.ndarray, alignment: str, site: bool) -> np.ndarray:
    """What MuJoCo's rays say, from the site or the arm's body."""
    reference = Reference(ARM.format(ground='<geom name="plane" type="plane" size="0 0 1"/>'))
    reference.data.qpos[:2] = ANGLES[world]
    mujoco.mj_kinematics(reference.model, reference.data)
    frame = reference.data.site("eye") if site else reference.data.body("arm")
    place, turn = (frame.xpos, frame.xmat.reshape(3, 3))
    if alignment == "world":
        turn = np.eye(3)
    if alignment == "yaw":
        yaw = math.atan2(turn[1, 0], turn[0, 0])
        turn = np.array([[math.cos(yaw), -math.sin(yaw), 0], [math.sin(yaw), math.cos(yaw), 0], [0, 0, 1]])
    found = []
    for origin, direction in zip(origins, directions, strict=True):
        geom = np.zeros(1, np.int32)
        start, way = place + turn @ origin, turn @ direction
        distance = mujoco.mj_ray(reference.model, reference.data, start, way, None, 1, -1, geom)
        found.append(min(distance, FAR) if distance >= 0 else FAR)
    return np.array(found)


@pytest.mark.parametrize("alignment", ["base", "yaw", "world"])
def test_a_scanner_measures_as_mujocos_rays_do(context: SensorContext, alignment: str) -> None:
    pattern = LidarPattern(count=40, elevations=(-0.3, 0.0, 0.2))
    built, distances = cast(context, site="eye", pattern=pattern, alignment=alignment)
    assert distances.shape == (2, 120) and len(built.names) == 120
    for world in range(2):
        requested = reported(world, *pattern.rays(), alignment, site=True)
        assert 0.1 < np.mean(requested < FAR) < 1.0, "the test sees everything or nothing"
        # an edge may fall on the other side of a ray
        assert np.mean(np.abs(distances[world] - requested) < 2e-3 * (1.0 + requested)) > 0.97


def test_rays_of_a_grid_go_down_from_outside_the_robot(context: SensorContext) -> None:
    grid = GridPattern(size=(0.4, 0.2), resolution=0.1)
    built, distances = cast(context, body="arm", pattern=grid, start=0.2, alignment="yaw")
    assert built.arrays.directions.numpy().tolist() == [[0.0, 0.0, -1.0]] * 15
    assert distances == pytest.approx(np.full((2, 15), 0.8), abs=1e-4), "1 m above the ground, less the start"


def test_a_half_circle_of_rays_by_hand() -> None:
    origins, directions = LidarPattern(count=2, elevations=(0.0, math.pi / 2), angle=math.pi).rays()
    assert not origins.any()
    half = math.sqrt(0.5)
    assert directions == pytest.approx(np.array([[half, -half, 0], [half, half, 0], [0, 0, 1], [0, 0, 1]]), abs=1e-9)


REFUSED: dict[str, dict[str, Any]] = {
    "RayCaster: give either body or site, and not both": {},
    "no body of robot matches 'arn'; did you mean arm": {"body": "arn"},
    "RayCaster.alignment is 'up'; use one of yaw, base, world": {"body": "arm", "alignment": "up"},
    "RayCaster.start is -1.0; use a number of metres >= 0": {"body": "arm", "start": -1.0},
    "LidarPattern has 0 rays in 1 rows; use 1 to 100,000": {"body": "arm", "pattern": LidarPattern(count=0)},
    "LidarPattern.angle is 7.0; use a number > 0, at most 2 pi": {"body": "arm", "pattern": LidarPattern(angle=7.0)},
    "LidarPattern.elevations is [2.0]; use numbers": {"body": "arm", "pattern": LidarPattern(elevations=(2.0,))},
}


@pytest.mark.parametrize("output", REFUSED)
def test_wrong_rays_are_refused_in_one_line(context: SensorContext, output: str) -> None:
    assert output in refusal(RayCaster(**REFUSED[output]).build, context)


@dataclass(frozen=True)
class ScanningConfig(SmallConfig):
    episode_seconds: float = 0.5
    rewards: Mapping[str, float] = reward_weights(clear=1.0)


class Scanning(Small):
    """A cart on a rail that sees a box ahead."""

    config_type = ScanningConfig
    text = """<mujoco><option gravity="0 0 0"/><worldbody><body name="cart" pos="0 0 1">
        <joint name="rail" type="slide" axis="1 0 0"/><geom type="sphere" size="0.1" mass="1" contype="0" conaffinity="0"/>
        </body></worldbody><actuator><motor joint="rail"/></actuator></mujoco>"""

    def objects(self, config: ScanningConfig) -> dict[str, Any]:
        return {"box": Box("box", size=(0.5, 1.0, 1.0), position=(3.0, 0.0, 1.0), fixed=True)}

    def sections(self) -> dict[str, Any]:
        return {
            "sensors": {"ahead": RayCaster(body="cart", pattern=LidarPattern(count=1, angle=0.1), start=0.2)},
            "observations": {"ahead": Observation(terms.ray_distance), "place": Observation(terms.joint_position)},
            "rewards": {"clear": Reward(terms.nearest_obstacle)},
            "events": {"place": Event(terms.reset_joints_in_range, position=(-1.0, 1.0))},
        }


def test_a_task_sees_and_is_rewarded_by_its_rays() -> None:
    task: Any = Scanning(ScanningConfig(), 4, seed=1)
    task.reset()
    face = 3.0 - 0.5 / 2 - 0.2
    for _ in range(7):  # an episode ends among them
        before = task.observations.clone()
        assert torch.allclose(before[:, 0] + before[:, 1], torch.full((4,), face), atol=1e-4)
        task.step(torch.zeros(4, 1))
        assert torch.allclose(task.rewards, before[:, 0], atol=1e-6), "rewards read what was seen before the action"
