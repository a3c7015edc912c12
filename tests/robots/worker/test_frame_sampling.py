"""A task whose worlds fail in one second of a motion: episodes begin there more and more often."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import warp as wp

from worker.tasks import (
    Action,
    Command,
    Declaration,
    DeclaredTask,
    EpisodeArrays,
    Metric,
    Observation,
    Reward,
    Robot,
    TaskConfig,
    Term,
    Termination,
    reward_weights,
    terms,
)

ROBOT = """<mujoco><option gravity="0 0 0"/><worldbody><body name="base" pos="0 0 1"><freejoint/>
  <geom type="sphere" size="0.1" mass="1" contype="0" conaffinity="0"/>
  <body name="arm" pos="0.2 0 0"><joint name="hinge" axis="0 0 1"/>
    <geom type="sphere" size="0.1" mass="1" contype="0" conaffinity="0"/></body></body></worldbody>
<actuator><motor joint="hinge"/></actuator></mujoco>"""
HZ, SECONDS, WORLDS = 10, 4, 64


@pytest.fixture(scope="module")
def motion(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("motion") / "turning.npz"
    frames = HZ * SECONDS
    still = np.zeros((frames, 2, 3), np.float32)
    places = np.tile(np.array([[0.0, 0.0, 1.0], [0.2, 0.0, 1.0]], np.float32), (frames, 1, 1))
    angles = np.linspace(0.0, 1.0, frames, dtype=np.float32)[:, None]
    upright = np.tile(np.array([1.0, 0.0, 0.0, 0.0], np.float32), (frames, 2, 1))
    np.savez(
        path,
        fps=np.array([HZ]),
        joint_pos=angles,
        joint_vel=np.zeros_like(angles),
        body_pos_w=places,
        body_quat_w=upright,
        body_lin_vel_w=still,
        body_ang_vel_w=still,
    )
    return path


@dataclass(frozen=True)
class TurningConfig(TaskConfig):
    control_hz: float = float(HZ)
    substeps: int = 1
    episode_seconds: float = 10.0
    motion: str = ""
    rewards: Mapping[str, float] = reward_weights(alive=1.0)


@wp.func
def hard_part(world: int, episodes: EpisodeArrays, command: int) -> bool:
    """The third second of the motion, from its second half on."""
    frame = episodes.memory[world, command]
    return frame >= 25.0 and frame < 30.0


class Turning(DeclaredTask):
    config_type = TurningConfig

    def robot(self, config: TurningConfig) -> Robot:
        return Robot(ROBOT)

    def declare(self, config: TurningConfig) -> Declaration:
        sampling = terms.AdaptiveSampling(even=0.5, rate=0.05)
        return Declaration(
            actions={"force": Action(terms.effort)},
            sensors={"motion": terms.Motion(config.motion, bodies="*", anchor="base", sampling=sampling)},
            commands={
                "frame": Command(terms.motion_command, names=["frame"], seconds=99.0, update=Term(terms.advance_motion))
            },
            observations={"wanted": Observation(terms.wanted_joint_position, command="frame")},
            rewards={"alive": Reward(terms.alive)},
            terminations={
                "hard": Termination(hard_part, command="frame"),
                "over": Termination(terms.motion_over, command="frame", time_out=True),
            },
            metrics={"evenness": Metric(terms.evenness_of_frames)},
        )


def begun(task: Any, steps: int) -> np.ndarray:
    """The second of the motion with which each episode of these steps began."""
    found, rest = [], torch.zeros(task.world_count, 1)
    for _ in range(steps):
        task.step(rest)
        frames = task.sensors["motion"].state_tensors()["frames"][task.dones]
        found += ((frames - 1) // HZ).tolist()
    return np.array(found)


def test_episodes_begin_where_they_failed_and_a_checkpoint_goes_on(motion: Path) -> None:
    config = TurningConfig(motion=str(motion))
    task, other = Turning(config, WORLDS, seed=1), Turning(config, WORLDS, seed=1)
    task.reset()
    first = begun(task, 20)
    later = begun(task, 150)
    shares = np.bincount(later.astype(int), minlength=SECONDS) / len(later)
    assert len(first) > 20 and shares[2] > 0.6 and (shares > 0).all(), shares
    assert float(task.sensors["motion"].arrays.sampling.evenness.numpy()[0]) < 0.9

    other.load_state_dict({name: value.clone() for name, value in task.state_dict().items()})
    assert begun(task, 30).tolist() == begun(other, 30).tolist()
    assert torch.equal(task.observations, other.observations)
