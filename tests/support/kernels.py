"""Compile the tasks' kernels into the tests' cache: no test then waits a minute for a compiler that another one runs.

``make test`` runs it before pytest. Without it every test passes too, in more time.
"""

from __future__ import annotations

import subprocess
import sys

import tests.conftest  # noqa: F401  the tests' cache, before Warp is imported


def compile_for(name: str) -> None:
    """The kernels of one task, and of all algorithms."""
    import warp

    from worker.distributed import Gang, Placement, warm_marker
    from worker.learning.algorithms import find_algorithm, installed
    from worker.learning.setup import load_kernels
    from worker.tasks import find_task

    warp.config.log_level = warp.LOG_WARNING
    for algorithm in installed():
        load_kernels(find_algorithm(algorithm), Gang(Placement(), "cpu", None, ["here"]))
    task = find_task(name)
    task(task.config_type(), 2, seed=1)
    warm_marker(task, "cpu").mkdir(parents=True, exist_ok=True)


def main() -> int:
    """One process a task, since Warp compiles on one core; the worst exit code."""
    building = [
        subprocess.Popen([sys.executable, "-m", "tests.support.kernels", name])
        for name in ("Cartpole", "CartpolePixels", "Ant", "Humanoid", "Quadruped")
    ]
    return max(process.wait() for process in building)


if __name__ == "__main__":
    if len(sys.argv) > 1:
        compile_for(sys.argv[1])
    else:
        sys.exit(main())
