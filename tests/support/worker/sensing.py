"""Small worlds with sensors, and MuJoCo's own engine put into the same state."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import mujoco
import newton
import numpy as np
import warp as wp

from worker.simulation.episodes import EpisodeArrays
from worker.simulation.robot import Robot
from worker.simulation.robot_elements import empty_builder
from worker.simulation.robot_view import RobotView, body_arrays
from worker.simulation.sensors.sensor import Sensor, SensorContext
from worker.simulation.terrain import Terrain
from worker.simulation.worlds import Worlds

WALKER = """<mujoco><option timestep="0.004"/><worldbody>
  <geom name="floor" type="plane" size="5 5 0.1"/>
  <body name="trunk" pos="0 0 {height}"><freejoint/>
    <geom name="trunk" type="box" size="0.2 0.1 0.05" pos="0.02 0.01 0" mass="3"/>
    <site name="imu" pos="0.1 0.02 0.03" euler="20 30 40"/>
    <body name="left" pos="0.05 0.16 0"><joint name="left" axis="0 1 0" pos="0.01 0 0.02" damping="0.3"/>
      <geom name="left_leg" type="capsule" fromto="0 0 0 0.02 0 -0.28" size="0.02" mass="0.4"/>
      <geom name="left_foot" type="sphere" pos="0.02 0 -0.31" size="0.04" mass="0.2"/>
      <site name="left_sole" pos="0.02 0 -0.35" euler="0 90 10"/>
      <body name="toe" pos="0.02 0 -0.31"><joint name="toe" type="ball" damping="0.05"/>
        <geom name="toe" type="box" size="0.03 0.02 0.01" pos="0.09 0 0" mass="0.1"/></body></body>
    <body name="right" pos="0.05 -0.16 0"><joint name="right" axis="1 0 0" damping="0.3"/>
      <geom name="right_leg" type="capsule" fromto="0 0 0 0 0 -0.28" size="0.02" mass="0.4"/>
      <geom name="right_foot" type="box" pos="0 0 -0.31" size="0.05 0.03 0.03" mass="0.2"/></body>
  </body></worldbody>
  <actuator><motor name="left" joint="left" gear="2"/><motor name="right" joint="right" gear="2"/></actuator>{sensors}</mujoco>"""
"""Two legs on a free trunk above a floor: the right one swings sideways, against the left one; a ball joint holds the toe."""
EXACT = {"iterations": 100, "ls_iterations": 50, "tolerance": 1e-8, "njmax": 120, "nconmax": 24}
"""Options of a solver that leaves no residue to speak of."""


def walker(height: float = 0.36, sensors: str = "") -> str:
    """:data:`WALKER` with its trunk so high [m], and with sensors for MuJoCo's own engine."""
    return WALKER.format(height=height, sensors=f"<sensor>{sensors}</sensor>")


def template_of(files: Mapping[str, str | Robot]) -> newton.ModelBuilder:
    """A world of robots and objects, declared or from MJCF texts, by name."""
    template = empty_builder()
    for name, text in files.items():
        if isinstance(text, Robot):
            text.add_to(template)
            continue
        part = empty_builder()
        part.add_mjcf(text, ctrl_direct=True)
        template.add_builder(part, label_prefix=name)
    return template


def scene(
    files: Mapping[str, str | Robot],
    world_count: int = 2,
    *,
    substeps: int = 1,
    timestep: float = 0.004,
    ground: bool | Terrain = False,
    **options: Any,
) -> SensorContext:
    """Worlds of :func:`template_of`, ready for sensors."""
    template = template_of(files)
    views = {name: RobotView(template, name) for name in files}
    worlds = Worlds(
        template,
        world_count,
        "cpu",
        timestep=timestep,
        substeps=substeps,
        fastest=1e6,
        ground=ground,
        solver_options=EXACT | options,
    )
    episodes = EpisodeArrays()
    episodes.ages = wp.ones(world_count, dtype=wp.int32, device="cpu")
    return SensorContext(
        worlds=worlds,
        views=views,
        robots={name: view.arrays(worlds) for name, view in views.items()},
        bodies=body_arrays(worlds),
        episodes=episodes,
        terrain=ground if isinstance(ground, Terrain) else None,
        control_hz=1.0 / (substeps * timestep),
    )


def step(context: SensorContext, *sensors: Sensor) -> None:
    """One control step and what the sensors say of it."""
    context.worlds.simulate()
    context.worlds.update_bodies()
    for sensor in sensors:
        sensor.advance()


class Reference:
    """MuJoCo's own engine with the model of one file.

    Args:
        text: The file, with the sensors that are asked for.
        options: Attributes of ``mjModel.opt``.
    """

    def __init__(self, text: str, **options: Any) -> None:
        self.model = mujoco.MjModel.from_xml_string(text)
        self.model.opt.iterations, self.model.opt.tolerance = 200, 1e-12
        for name, value in options.items():
            setattr(self.model.opt, name, value)
        self.data = mujoco.MjData(self.model)

    def take(self, context: SensorContext, world: int) -> None:
        """Be in the state in which one world's solver is now, and compute everything that follows from it."""
        data = context.worlds.solver.mjw_data
        self.data.qpos[:] = data.qpos.numpy()[world]
        self.data.qvel[:] = data.qvel.numpy()[world]
        self.data.ctrl[:] = context.worlds.arrays.controls.numpy()[world]
        mujoco.mj_forward(self.model, self.data)

    def sensor(self, name: str) -> np.ndarray:
        """What a sensor of the file says."""
        reported: np.ndarray = self.data.sensor(name).data.copy()
        return reported

    def contacts(self) -> list[tuple[str, str, np.ndarray]]:
        """Names of the two geoms of each contact, and the force on the second in the world frame [N]."""
        found = []
        for index in range(self.data.ncon):
            contact, force = self.data.contact[index], np.zeros(6)
            mujoco.mj_contactForce(self.model, self.data, index, force)
            if contact.efc_address >= 0:
                names = [self.model.geom(int(geom)).name for geom in contact.geom]
                found.append((names[0], names[1], contact.frame.reshape(3, 3).T @ force[:3]))
        return found
