"""Compile the tasks' kernels into the tests' cache: no test then waits a minute for a compiler that another one runs.

``make test`` runs it before pytest. Without it every test passes too, in more time.
"""

from __future__ import annotations

import subprocess
import sys

from tests.conftest import REPOSITORY

BUILD = """
import warp
from worker.distributed import Gang, Placement, warm_marker
from worker.learning.algorithms import BUILT_IN, find_algorithm
from worker.learning.setup import load_kernels
from worker.tasks import find_task

warp.config.log_level = warp.LOG_WARNING
for algorithm in BUILT_IN:
    load_kernels(find_algorithm(algorithm), Gang(Placement(), "cpu", None, ["here"]))
task = find_task({name!r})
task(task.config_type(), 2, seed=1)
warm_marker(task, "cpu").mkdir(parents=True, exist_ok=True)
"""


def main() -> int:
    """One process a task, since Warp compiles on one core; the worst exit code."""
    building = [
        subprocess.Popen([sys.executable, "-c", BUILD.format(name=name)], cwd=REPOSITORY)
        for name in ("Cartpole", "CartpolePixels", "Ant", "Humanoid", "Quadruped")
    ]
    return max(process.wait() for process in building)


if __name__ == "__main__":
    sys.exit(main())
