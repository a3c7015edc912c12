"""A task with a camera on a moving robot: a cart on a rail before a box, seen in every way."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import field
from typing import Any, ClassVar

import warp as wp
from pydantic.dataclasses import dataclass

from worker.settings.ppo import PPOConfig
from worker.settings.rsl_rl import RslRlConfig
from worker.settings.task import STRICT, TaskConfig, reward_weights
from worker.simulation.objects import Box
from worker.simulation.robot import Robot
from worker.simulation.robot_arrays import RobotArrays
from worker.simulation.sensors.camera import CameraArrays, CameraSensor
from worker.simulation.worlds import WorldArrays
from worker.tasks import terms
from worker.tasks.declare.declaration import Action, Declaration, Event, Image, Observation, Reward
from worker.tasks.run.task import Task

wp.set_module_options({"enable_backward": False})

CART = """<mujoco><option gravity="0 0 0"/><worldbody>
  <body name="cart" pos="0 0 1"><joint name="rail" type="slide" axis="0 1 0" damping="1"/>
    <geom name="cart" type="box" size="0.1 0.1 0.05" mass="1" contype="0" conaffinity="0" rgba="1 0 0 1"/>
    <site name="mast" pos="0 0 0.3" euler="0 0 90"/></body></worldbody>
  <actuator><motor name="rail" joint="rail" gear="5"/></actuator></mujoco>"""
"""A cart that slides along y, 1 m above the ground; its mast's x axis points along y."""
CNN = {
    "class_name": "CNNModel",
    "hidden_dims": [16],
    "activation": "elu",
    "cnn_cfg": {"output_channels": [4, 8], "kernel_size": [3, 3], "stride": [2, 2], "activation": "elu"},
}
"""A small network that takes images of 12 x 16 and more."""
NETWORKS: dict[str, Any] = {
    "obs_groups": {"actor": ["policy", "camera"], "critic": ["critic"]},
    "actor": CNN | {"distribution_cfg": {"class_name": "GaussianDistribution", "init_std": 1.0}},
    "critic": {"class_name": "MLPModel", "hidden_dims": [16], "activation": "elu"},
}
"""Settings of rsl_rl: the actor sees numbers and images."""


@wp.func
def place(world: int, worlds: WorldArrays, robot: RobotArrays, stream: wp.uint32, spread: float):
    """Put the cart somewhere on its rail."""
    worlds.joint_q[world, robot.coordinates[0]] = wp.randf(stream, -spread, spread)


@wp.func
def ahead(world: int, camera: CameraArrays) -> float:
    """Depth in the middle of the image [m]."""
    return camera.depths[world, camera.depths.shape[1] / 2, camera.depths.shape[2] / 2]


@dataclass(frozen=True, config=STRICT)
class SeeingConfig(TaskConfig):
    """Stay in the middle of the rail."""

    episode_seconds: float = 0.5
    spread: float = 0.3
    rewards: Mapping[str, float] = reward_weights(middle=-1.0)
    ppo: PPOConfig = field(default_factory=lambda: PPOConfig(steps=4, hidden_sizes=(8,), minibatches=1, epochs=1))
    rsl_rl: RslRlConfig = field(
        default_factory=lambda: RslRlConfig(
            num_steps_per_env=4, algorithm={"num_mini_batches": 2, "num_learning_epochs": 1}, **NETWORKS
        )
    )
    further_groups: ClassVar[Mapping[str, bool]] = {"camera": True}


class Seeing(Task):
    """The cart looks ahead, at a box 2 m before it."""

    config_type = SeeingConfig
    ground = True
    camera: ClassVar[CameraSensor] = CameraSensor(body="cart", position=(0.15, 0.0, 0.0), width=16, height=12, frames=2)

    def robot(self, config: Any) -> Robot:
        return Robot(CART)

    def objects(self, config: Any) -> Mapping[str, Any]:
        return {"box": Box("box", size=(0.4, 0.6, 0.8), position=(2.35, 0.0, 1.0), fixed=True, color=(0.0, 0.0, 1.0))}

    def seen(self) -> dict[str, Any]:
        """The observation groups of this task."""
        return {"policy": {"velocity": Observation(terms.joint_velocity)}, "camera": Image("front")}

    def declare(self, config: Any) -> Declaration:
        return Declaration(
            actions={"push": Action(terms.effort)},
            observations=self.seen() | {"critic": {"position": Observation(terms.joint_position)}},
            rewards={"middle": Reward(terms.joint_deviation_squared)},
            events={"place": Event(place, spread=config.spread)},
            sensors={"front": self.camera},
        )


class SeeingDepth(Seeing):
    """As :class:`Seeing`, with depth that a term reads as well, from a mount that each episode draws."""

    camera: ClassVar[CameraSensor] = CameraSensor(
        body="cart",
        position=(0.25, 0.0, 0.0),  # nowhere within the cart
        width=16,
        height=12,
        kind="depth",
        far=4.0,
        position_range=(0.1, 0.0, 0.0),
        redraw=True,
    )

    def seen(self) -> dict[str, Any]:
        return {
            "policy": {"velocity": Observation(terms.joint_velocity), "ahead": Observation(ahead)},
            "camera": Image("front"),
        }


class SeeingAlone(Seeing):
    """As :class:`Seeing`, where the policy sees an image alone."""

    class Config(SeeingConfig):
        further_groups: ClassVar[Mapping[str, bool]] = {"policy": True}

    config_type = Config

    def seen(self) -> dict[str, Any]:
        return {"policy": Image("front")}
