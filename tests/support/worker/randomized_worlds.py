"""Worlds of one robot or object, and their randomisations, without a task."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import warp as wp

from tests.support.worker.sensing import template_of
from worker.simulation.declared_randomization import Randomize
from worker.simulation.episodes import EpisodeArrays
from worker.simulation.randomizations import Randomizations
from worker.simulation.robot import Robot
from worker.simulation.robot_arrays import RobotArrays
from worker.simulation.robot_view import RobotView
from worker.simulation.worlds import Worlds

WORLDS, TIMESTEP = 2, 0.004
ARM = """<mujoco><compiler angle="radian"/><default><geom contype="0" conaffinity="0"/></default><worldbody>
<body name="upper" pos="0 0 1"><joint name="shoulder" axis="0 1 0" range="-0.3 2" damping="0.3" armature="0.02" frictionloss="0.1"/>
  <geom type="box" size="0.15 0.04 0.03" pos="0.15 0 0" mass="1.5"/>
  <body name="fore" pos="0.3 0 0"><joint name="elbow" axis="0 1 0" range="-1 1" damping="0.1" armature="0.01" frictionloss="0.05"/>
    <geom type="box" size="0.12 0.03 0.02" pos="0.12 0.01 0" mass="0.8"/>{load}
    <body name="hand" pos="0.24 0 0"><joint name="wrist" axis="1 0 0" range="-2 2" damping="0.02" armature="0.004"/>
      <geom type="box" size="{hand} 0.06 0.01" pos="0.04 0.02 0" mass="0.4"/>
      <body name="finger" pos="0.08 0 0"><joint name="slide" type="slide" axis="0 1 0" range="-0.05 0.05" damping="1" armature="0.1"/>
        <geom type="sphere" size="0.02" mass="0.2"/></body></body></body></body>
</worldbody><actuator>
  <position joint="shoulder" kp="20" kv="1" forcerange="-9 9"/><velocity joint="elbow" kv="0.8"/>
  <motor joint="wrist" gear="0.5"/><position joint="slide" kp="150" kv="4"/>
</actuator></mujoco>"""


def build_arm(count: int = WORLDS) -> tuple[Worlds, RobotView]:
    """Worlds of :data:`ARM`."""
    return build_worlds(ARM.format(load="", hand=0.04), count, njmax=20, nconmax=0, disable_contacts=True)


def build_worlds(
    robot: str | Robot, count: int = WORLDS, ground: bool = False, **options: object
) -> tuple[Worlds, RobotView]:
    """Worlds of a robot, declared or from an MJCF text."""
    template = template_of({"robot": robot})
    options = {"iterations": 50, "ls_iterations": 50, "tolerance": 1e-8, **options}
    worlds = Worlds(
        template, count, "cpu", timestep=TIMESTEP, substeps=1, fastest=1e3, ground=ground, solver_options=options
    )
    return worlds, RobotView(template, "robot")


def build_episodes(count: int = WORLDS, first_world: int = 0, seed: int = 7) -> EpisodeArrays:
    episodes = EpisodeArrays()
    keys = [[seed, first_world + world, 0] for world in range(count)]
    episodes.random = wp.array(np.array(keys, np.int32), dtype=wp.int32, device="cpu")
    episodes.ages = wp.zeros(count, dtype=wp.int32, device="cpu")
    return episodes


CONTROL_HZ = 50.0


def randomize(
    entries: Mapping[str, Randomize],
    worlds: Worlds,
    view: RobotView,
    episodes: EpisodeArrays | None = None,
    robot: RobotArrays | None = None,
) -> Randomizations:
    episodes = episodes or build_episodes(worlds.world_count)
    robots = {"robot": robot or view.arrays(worlds)}
    return Randomizations(entries, worlds, episodes, {"robot": view}, robots, CONTROL_HZ)
