"""A four-legged ant that runs along +x."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

from tests.support.worker.kernels.running import Running, observation_names
from worker.tasks.configs.running import AntConfig

JOINT_NAMES = tuple(f"{part}_{leg}" for leg in range(1, 5) for part in ("hip", "ankle"))
"""The model file's hinges in the order of the joint coordinates."""


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
