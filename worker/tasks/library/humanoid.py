"""A humanoid that runs along +x."""

from __future__ import annotations

from worker.settings.running import HumanoidConfig
from worker.tasks.library.running import Running


class Humanoid(Running):
    """Newton's bundled ``nv_humanoid.xml``: 74 observations, 21 actions, 60 control steps a second, episodes of 16 s."""

    config_type = HumanoidConfig
    asset = "nv_humanoid.xml"
    solver_options = {
        # At most 16 contacts and 37 rows were seen in 96 worlds x 400 steps of random, zero and held random actions with
        # 1,232 falls (data.nacon and data.nefc after each step, limits at the worst case of 35 and 161).
        "nconmax": 25,
        "njmax": 80,
        # On an H200 falls and heights under random actions stayed those of the model file's limits, in 3/4 of the time.
        "iterations": 3,
        "ls_iterations": 6,
        "tolerance": 1.0e-3,
    }
