"""A task with worlds that fail in one second of a motion."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from tests.support.worker.declared import Small, SmallConfig
from worker.tasks import Command, EpisodeArrays, Metric, Observation, Term, Termination, terms

ROBOT = """<mujoco><option gravity="0 0 0"/><worldbody><body name="base" pos="0 0 1"><freejoint/>
  <geom type="sphere" size="0.1" mass="1" contype="0" conaffinity="0"/>
  <body name="arm" pos="0.2 0 0"><joint name="hinge" axis="0 0 1"/>
    <geom type="sphere" size="0.1" mass="1" contype="0" conaffinity="0"/></body></body></worldbody>
<actuator><motor joint="hinge"/></actuator></mujoco>"""
HZ, SECONDS, WORLDS = int(SmallConfig.control_hz), 4, 64


def motion(path: Path) -> Path:
    """A file in which the hinge turns and nothing else moves."""
    frames = HZ * SECONDS
    still = np.zeros((frames, 2, 3), np.float32)
    places = np.tile(np.array([[0.0, 0.0, 1.0], [0.2, 0.0, 1.0]], np.float32), (frames, 1, 1))
    angles = np.linspace(0.0, 1.0, frames, dtype=np.float32)[:, None]
    upright = np.tile(np.array([1.0, 0.0, 0.0, 0.0], np.float32), (frames, 2, 1))
    joints: dict[str, Any] = {"joint_pos": angles, "joint_vel": np.zeros_like(angles)}
    bodies: dict[str, Any] = {
        "body_pos_w": places,
        "body_quat_w": upright,
        "body_lin_vel_w": still,
        "body_ang_vel_w": still,
    }
    np.savez(path, fps=np.array([HZ]), **joints, **bodies)
    return path


@wp.func
def hard_part(world: int, episodes: EpisodeArrays, command: int) -> bool:
    """The third second of the motion, from its second half on."""
    frame = episodes.memory[world, command]
    return frame >= 25.0 and frame < 30.0


class Turning(Small):
    text = ROBOT
    motion: Path

    def sections(self) -> dict[str, Any]:
        sampling, advance = terms.AdaptiveSampling(even=0.5, rate=0.05), Term(terms.advance_motion)
        return {
            "sensors": {"motion": terms.Motion(self.motion, bodies="*", anchor="base", sampling=sampling)},
            "commands": {"frame": Command(terms.motion_command, names=["frame"], seconds=99.0, update=advance)},
            "observations": {"target": Observation(terms.wanted_joint_position, command="frame")},
            "events": {},
            "terminations": {
                "hard": Termination(hard_part, command="frame"),
                "over": Termination(terms.motion_over, command="frame", time_out=True),
            },
            "metrics": {"evenness": Metric(terms.evenness_of_frames)},
        }
