"""A task of one's own, whole, in sixty lines of code: swing a pendulum up. `job_specs/my-task.yaml` trains it."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import warp as wp

from worker.tasks import (
    Action,
    Declaration,
    Event,
    Observation,
    Reward,
    Robot,
    RobotArrays,
    Task,
    TaskConfig,
    WorldArrays,
    reward_weights,
    terms,
)

MODEL = """<mujoco><worldbody><body pos="0 0 1">
  <joint name="hinge" type="hinge" axis="0 1 0" damping="0.02"/>
  <geom type="capsule" fromto="0 0 0 0 0 -0.5" size="0.03" mass="0.5" contype="0" conaffinity="0"/>
</body></worldbody><actuator><motor joint="hinge" gear="2"/></actuator></mujoco>"""


@dataclass(frozen=True)
class PendulumConfig(TaskConfig):
    episode_seconds: float = 4.0
    torque: float = 1.0  # share of the motor's full torque that an action of 1 uses
    rewards: Mapping[str, float] = reward_weights(upright=1.0, speed=-0.01, effort=-0.01)


@wp.func
def direction(world: int, worlds: WorldArrays, robot: RobotArrays, joint: int) -> wp.vec2:
    angle = worlds.joint_q[world, robot.coordinates[joint]]
    return wp.vec2(wp.cos(angle), wp.sin(angle))


@wp.func
def pointing(world: int, worlds: WorldArrays, robot: RobotArrays, joint: int, target: float) -> float:
    return wp.cos(worlds.joint_q[world, robot.coordinates[joint]] - target)


class Pendulum(Task):
    """A pendulum that hangs down and a motor that must swing it up: 3 observations, 1 action."""

    config_type = PendulumConfig
    solver_options = {"disable_contacts": True, "njmax": 1, "nconmax": 0}

    def robot(self, config):
        return Robot(MODEL)

    def declare(self, config):
        return Declaration(
            actions={"torque": Action(terms.effort, scale=config.torque)},
            observations={
                "direction": Observation(direction, names=["cosine", "sine"]),
                "velocity": Observation(terms.joint_velocity, names=["velocity"], scale=0.1, unit="rad/s"),
            },
            rewards={
                "upright": Reward(pointing, target=math.pi),
                "speed": Reward(terms.joint_velocity_squared),
                "effort": Reward(terms.action_squared),
            },
            events={"place": Event(terms.reset_joints_by_offset, position=(-math.pi, math.pi))},
        )
