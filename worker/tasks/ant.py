"""A four-legged ant that runs along +x."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from worker.tasks.config import reward_weights
from worker.tasks.running import Running, RunningConfig, observation_names

JOINT_NAMES = tuple(f"{part}_{leg}" for leg in range(1, 5) for part in ("hip", "ankle"))
"""The model file's hinges in the order of the joint coordinates."""


@dataclass(frozen=True)
class AntConfig(RunningConfig):
    """Run fast, straight and upright; do not drop the torso. What the rewards are: :class:`RunningConfig`."""

    fall_height: float = 0.31
    """Height of the torso under which the episode ends [m]."""
    start_height: float = 0.62
    """Height of the torso at the start [m]: the feet touch the ground within a few steps."""
    velocity_scale: float = 0.2
    """Factor on joint velocities in observations and in the energy cost [s/rad]."""
    rewards: Mapping[str, float] = reward_weights(
        forward=1.0, heading=0.5, up=0.1, alive=0.5, action=-0.005, energy=-0.05, limits=-0.1, fall=-2.0
    )


class Ant(Running):
    """Newton's bundled ``nv_ant.xml``: 35 observations, 8 actions, 60 control steps a second, episodes of 16 s."""

    config_type = AntConfig
    observation_names = observation_names(JOINT_NAMES)
    action_names = JOINT_NAMES
    asset = "nv_ant.xml"
    # ankles bent outwards: the pose that the model file gives as init_qpos
    start_pose: ClassVar[Mapping[str, float]] = {"ankle_1": 1.0, "ankle_2": -1.0, "ankle_3": -1.0, "ankle_4": 1.0}
    solver_options: ClassVar[dict[str, object]] = {
        # The worst case: 12 capsules with two contacts and one sphere with one, four rows each, and eight joint limits.
        "nconmax": 25,
        "njmax": 108,
        # Falls and heights are those of the file's 50 iterations at 1e-10, for a fraction of the time.
        "iterations": 3,
        "ls_iterations": 6,
        "tolerance": 1.0e-3,
    }
