"""Evaluation of velocity-following policies of any system: tracking errors and episode lengths in the same worlds."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any, Protocol

import torch
import warp as wp

from worker.learning.setup import observed
from worker.simulation.robot_view import body_arrays
from worker.tasks.run.task import Task

COMMAND = ("command_forward", "command_left", "command_turn")
"""Names of the command's observations: velocities forward and left [m/s], turning velocity to the left [rad/s]."""


class Acting(Protocol):
    """The part of a policy that the evaluation needs."""

    def act(self, observations: Any) -> torch.Tensor:
        """Mean actions, shape (worlds, actions), for the task's observation groups."""

    def reset(self, worlds: torch.Tensor | None = None) -> None:
        """Clear the recurrent state."""


@dataclass(frozen=True)
class Judgement:
    """Results of a policy's mean actions over the first episode of each world.

    Attributes:
        episodes: Number of episodes.
        linear_error: Mean distance between the commanded velocity forward and left and that of the root's origin, in its own frame
            [m/s].
        angular_error: Mean difference between the commanded turning velocity and that about the root's own vertical axis [rad/s].
        length_share: Mean length of an episode, as a share of the longest that it can be.
        full_length: Share of the episodes that only the clock ended.
        mean_return: Mean sum of rewards.
        judging_s: Wall time [s].
    """

    episodes: int
    linear_error: float
    angular_error: float
    length_share: float
    full_length: float
    mean_return: float
    judging_s: float


class VelocityErrors:
    """Errors of a robot's velocities relative to its commands, read from the simulation, not from the task's own terms.

    Args:
        task: A task whose policy sees a velocity command, and whose robot is called ``robot``.

    Raises:
        ValueError: The task has no such command, or no free robot of that name.
    """

    def __init__(self, task: Task) -> None:
        name, names = type(task).__name__, list(task.observation_names)
        if not set(COMMAND) <= set(names):
            raise ValueError(
                f"task {name} can't be judged: it commands no velocities; tasks that do observe {', '.join(COMMAND)}"
            )
        views = getattr(task, "views", {})
        if "robot" not in views or views["robot"].root_coordinate < 0:
            raise ValueError(f"task {name} can't be judged: it has no free robot called robot")
        robot = views["robot"]
        self._observations = task.groups["policy"]
        self._columns = [names.index(each) for each in COMMAND]
        self._coordinates = wp.to_torch(task.worlds.arrays.joint_q)
        self._velocities = wp.to_torch(task.worlds.arrays.joint_qd)
        self._first, self._dof = robot.root_coordinate + 3, robot.root_dof
        self._center = wp.to_torch(body_arrays(task.worlds).coms)[:, robot.root_body]

    def commands(self) -> torch.Tensor:
        """The present command, shape (worlds, 3): forward [m/s], left [m/s], turn [rad/s]; a copy."""
        return self._observations[:, self._columns].clone()

    def errors(self, commands: torch.Tensor) -> torch.Tensor:
        """Distance of the present velocities from ``commands``, shape (worlds, 2): linear [m/s], angular [rad/s]."""
        rotation = self._coordinates[:, self._first : self._first + 4]
        linear, angular = (
            self._velocities[:, self._dof : self._dof + 3],
            self._velocities[:, self._dof + 3 : self._dof + 6],
        )
        turning = rotate_back(rotation, angular)
        # the simulation has the velocity of the centre of mass; the origin turns about it
        forward = rotate_back(rotation, linear) - torch.linalg.cross(turning, self._center)
        planar = torch.linalg.vector_norm(forward[:, :2] - commands[:, :2], dim=1)
        return torch.stack([planar, (turning[:, 2] - commands[:, 2]).abs()], dim=1)


def rotate_back(rotation: torch.Tensor, vector: torch.Tensor) -> torch.Tensor:
    """Vectors of the world frame, shape (n, 3), in frames of these rotations, quaternions xyzw, shape (n, 4)."""
    axis, real = -rotation[:, :3], rotation[:, 3:]
    twice = 2.0 * torch.linalg.cross(axis, vector)
    turned: torch.Tensor = vector + real * twice + torch.linalg.cross(axis, twice)
    return turned


def judge(task: Task, policy: Acting) -> Judgement:
    """One whole episode of every world, from a fresh start, with the task's own noise, pushes and randomisation.

    The last step of an episode is not in the errors: the world has begun a new one by then.

    Args:
        task: The worlds, used for that episode only.
        policy: Takes the mean actions.

    Raises:
        ValueError: The task can't be judged: :class:`VelocityErrors`.
    """
    started = time.perf_counter()
    measured = VelocityErrors(task)
    task.reset()
    policy.reset()
    observations = observed(task)
    # float64: sums of a million steps
    totals = torch.zeros(task.world_count, 5, device=task.device, dtype=torch.float64)
    running = torch.ones(task.world_count, device=task.device, dtype=torch.bool)
    for step in range(task.max_episode_length):
        commands = measured.commands()
        task.step(policy.act(observations))
        policy.reset(task.dones)
        ended = task.dones != 0
        within = running & ~ended
        totals[:, :2] += torch.where(within[:, None], measured.errors(commands), 0.0)
        totals[:, 2] += running
        totals[:, 3] += running & (task.time_outs > 0)
        totals[:, 4] += torch.where(running, task.rewards, 0.0)
        running &= ~ended
        # reading waits for the device, so read seldom
        if step % 32 == 31 and not bool(running.any()):
            break
    linear, angular, steps, full, returns = totals.sum(0).tolist()
    counted = max(1.0, steps - task.world_count)
    return Judgement(
        episodes=task.world_count,
        linear_error=linear / counted,
        angular_error=angular / counted,
        length_share=steps / task.world_count / task.max_episode_length,
        full_length=full / task.world_count,
        mean_return=returns / task.world_count,
        judging_s=time.perf_counter() - started,
    )
