"""A humanoid that runs along +x."""

from __future__ import annotations

from typing import ClassVar

from tests.support.worker.kernels.running import Running, observation_names
from worker.tasks.configs.running import HumanoidConfig

JOINT_NAMES = (
    *("abdomen_z", "abdomen_y", "abdomen_x"),
    *("right_hip_x", "right_hip_z", "right_hip_y", "right_knee", "right_ankle_y", "right_ankle_x"),
    *("left_hip_x", "left_hip_z", "left_hip_y", "left_knee", "left_ankle_y", "left_ankle_x"),
    *("right_shoulder1", "right_shoulder2", "right_elbow"),
    *("left_shoulder1", "left_shoulder2", "left_elbow"),
)
"""The model file's hinges in the order in which its bodies hold them, which is that of the joint coordinates."""


class Humanoid(Running):
    """Newton's bundled ``nv_humanoid.xml``: 74 observations, 21 actions, 60 control steps a second, episodes of 16 s."""

    config_type = HumanoidConfig
    observation_names = observation_names(JOINT_NAMES)
    action_names = JOINT_NAMES
    asset = "nv_humanoid.xml"
    solver_options: ClassVar[dict[str, object]] = {
        # At most 16 contacts and 37 rows were seen in 96 worlds x 400 steps of random, zero and held random actions with
        # 1,232 falls (data.nacon and data.nefc after each step, limits at the worst case of 35 and 161).
        "nconmax": 25,
        "njmax": 80,
        # On an H200 falls and heights under random actions stayed those of the model file's limits, in 3/4 of the time.
        "iterations": 3,
        "ls_iterations": 6,
        "tolerance": 1.0e-3,
    }
