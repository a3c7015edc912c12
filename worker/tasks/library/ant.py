"""A four-legged ant that runs along +x."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

from worker.settings.running import AntConfig
from worker.tasks.library.running import Running


class Ant(Running):
    """Newton's bundled ``nv_ant.xml``: 35 observations, 8 actions, 60 control steps a second, episodes of 16 s."""

    config_type = AntConfig
    asset = "nv_ant.xml"
    # ankles bent outwards: the pose that the model file gives as init_qpos
    start_pose: ClassVar[Mapping[str, float]] = {"ankle_1": 1.0, "ankle_2": -1.0, "ankle_3": -1.0, "ankle_4": 1.0}
    solver_options = {
        # The worst case: 12 capsules with two contacts and one sphere with one, four rows each, and eight joint limits.
        "nconmax": 25,
        "njmax": 108,
        # Falls and heights match those of the file's 50 iterations at 1e-10, in a fraction of the time.
        "iterations": 3,
        "ls_iterations": 6,
        "tolerance": 1.0e-3,
    }
