"""Small tasks: two sliders with motors, without contacts and gravity, so that every number follows by hand."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
import warp as wp

from worker.settings.task import TaskConfig
from worker.tasks import (
    Action,
    Adaptive,
    Command,
    Curriculum,
    Declaration,
    EpisodeArrays,
    Event,
    Metric,
    Observation,
    Randomize,
    Reward,
    Robot,
    RobotArrays,
    Termination,
    WorldArrays,
    reward_weights,
    terms,
)
from worker.tasks.run.task import Task

MODEL = """<mujoco><option gravity="0 0 0"/><worldbody><body name="near" pos="0 0 1">
  <joint name="first" type="slide" axis="1 0 0" range="-2 2"/>
  <geom type="sphere" size="0.1" mass="1" contype="0" conaffinity="0"/>
  <body name="far" pos="1 0 0">
    <joint name="second" type="slide" axis="1 0 0"/>
    <geom type="sphere" size="0.1" mass="1" contype="0" conaffinity="0"/>
  </body></body></worldbody>
<actuator><motor joint="first" gear="2"/><motor joint="second" gear="3"/></actuator></mujoco>"""


@dataclass(frozen=True)
class SlidersConfig(TaskConfig):
    control_hz: float = 10.0
    substeps: int = 1
    episode_seconds: float = 1.2
    rewards: Mapping[str, float] = reward_weights(place=1.0, change=-0.5, alive=2.0, fall=-3.0)


@wp.func
def anywhere(world: int, worlds: WorldArrays, robot: RobotArrays, joint: int, stream: wp.uint32, place: wp.vec2):
    worlds.joint_q[world, robot.coordinates[joint]] = wp.randf(stream, place[0], place[1])
    worlds.joint_qd[world, robot.dofs[joint]] = 0.0


@wp.func
def target(world: int, episodes: EpisodeArrays, stream: wp.uint32, command: int, place: wp.vec2):
    episodes.memory[world, command] = wp.randf(stream, place[0], place[1])


@wp.func
def count_episodes(world: int, episodes: EpisodeArrays, lasting: int, by: float):
    episodes.lasting[world, lasting] = episodes.lasting[world, lasting] + by


@wp.func
def counted(world: int, episodes: EpisodeArrays) -> float:
    return episodes.lasting[world, 0]


@wp.func
def kick(world: int, worlds: WorldArrays, robot: RobotArrays, joint: int, speed: float):
    worlds.joint_qd[world, robot.dofs[joint]] = speed


@wp.func
def distant(world: int, worlds: WorldArrays, robot: RobotArrays, joint: int, limit: float) -> bool:
    return wp.abs(worlds.joint_q[world, robot.coordinates[joint]]) > limit


def both(task: Task, gain: float) -> torch.Tensor:
    """A torch term: the positions of both sliders, times ``gain``."""
    places: torch.Tensor = gain * wp.to_torch(task.worlds.arrays.joint_q)
    return places


def no_actions(task: Task) -> torch.Tensor:
    """A torch term: 1 where the first action is 0."""
    return (task.actions[:, 0] == 0.0).float()


@dataclass(frozen=True)
class SmallConfig(TaskConfig):
    control_hz: float = 10.0
    substeps: int = 1
    rewards: Mapping[str, float] = reward_weights(alive=1.0)


class Small(Task):
    """A robot that is asked for nothing; a subclass names its file, and the sections of the declaration that matter."""

    config_type = SmallConfig
    text = MODEL

    def robot(self, config: SmallConfig) -> Robot:
        return Robot(self.text)

    def sections(self) -> dict[str, Any]:
        """In place of those that every task has."""
        return {}

    def declare(self, config: SmallConfig) -> Declaration:
        usual: dict[str, Any] = {
            "actions": {"force": Action(terms.effort)},
            "observations": {"place": Observation(terms.joint_position)},
            "rewards": {"alive": Reward(terms.alive)},
            "events": {"place": Event(terms.reset_to_default)},
        }
        return Declaration(**{**usual, **self.sections()})


class Sliders(Task):
    """Two sliders: every kind of term once."""

    config_type = SlidersConfig
    solver_options = {"disable_contacts": True, "njmax": 2, "nconmax": 0}

    def robot(self, config: SlidersConfig) -> Robot:
        return Robot(MODEL)

    def declare(self, config: SlidersConfig) -> Declaration:
        return Declaration(**self.sections())

    def sections(self) -> dict[str, Any]:
        return {
            "actions": {
                "force": Action(terms.effort, scale={"first": 0.5, "second": 1.0}, offset=0.25, clip=(-2.0, 2.0))
            },
            "observations": {
                "policy": {
                    "place": Observation(terms.joint_position, offset=(0.5, 0.0), scale=(2.0, 1.0), clip=(-0.8, 0.8)),
                    "late": Observation(terms.joint_velocity, joints="first", delay=2, history=3),
                    "noisy": Observation(terms.joint_position, joints="second", noise=0.1, names=("noisy",)),
                    "target": Observation(terms.command_number, names=("target",)),
                    "last": Observation(terms.last_action),
                },
                "critic": {"place": Observation(terms.joint_position), "count": Observation(counted)},
            },
            "rewards": {
                "place": Reward(terms.joint_position, joints="first"),
                "change": Reward(terms.action_rate_squared, per_second=True),
                "alive": Reward(terms.alive, unless_terminated=True),
                "fall": Reward(terms.ended),
            },
            "metrics": {"speed": Metric(terms.joint_speed)},
            "terminations": {
                "first_left": Termination(distant, joints="first", limit=1.5),
                "second_left": Termination(distant, joints="second", limit=1.5, time_out=True),
            },
            "commands": {
                "target": Command(target, names=("place",), units=("m",), place=(-1.0, 1.0), seconds=(0.3, 0.5))
            },
            "events": {
                "place": Event(anywhere, place=(-0.5, 0.5)),
                "kick": Event(kick, joints="second", speed=0.75, when="interval", seconds=(0.4, 0.4)),
            },
            "curricula": {
                "count": Curriculum(count_episodes, by=1.0, lasting=1),
                "kicks": Adaptive("events.kick.speed", 0.75, 1.75, steps=2, above=5.0, below=-5.0),
            },
            "randomize": {"mass": Randomize("mass", bodies="near", range=(0.5, 2.0))},
        }


class FreeSliders(Sliders):
    """The same robot, without clipped actions."""

    def sections(self) -> dict[str, Any]:
        return super().sections() | {"actions": {"force": Action(terms.effort, clip=None)}}


class TorchSliders(Sliders):
    """The same robot with terms in torch."""

    def sections(self) -> dict[str, Any]:
        sections = super().sections()
        return sections | {
            "observations": {
                "both": Observation(both, gain=3.0, size=2, noise=0.0),
                "place": Observation(terms.joint_position),
            },
            "rewards": sections["rewards"] | {"alive": Reward(no_actions)},
        }
