"""Compile the tasks' kernels into the tests' cache: no test then waits a minute for a compiler that another one runs.

``make`` runs it before pytest. Without it every test passes too, in more time. What was compiled from the same sources before
costs nothing.
"""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from importlib.metadata import entry_points
from pathlib import Path

from tests.support.suite.caches import kernel_cache

REPOSITORY = Path(__file__).parents[3]
CACHE = Path(os.environ.setdefault("WARP_CACHE_PATH", str(kernel_cache())))
TASKS = ("Humanoid", "Ant", "Cartpole", "Quadruped", "CartpolePixels", "Racer", "RacerPixels")
"""Those of the tests of three tiers, as far as they are installed; ``make robots`` names its own."""


def compile_for(name: str) -> None:
    """The kernels of one task, and of all algorithms."""
    import warp

    from worker.kernels.compiling import directory
    from worker.kernels.warm_start import mark_of
    from worker.learning.algorithms import find_algorithm, installed
    from worker.learning.distributed import Gang, RankPlacement
    from worker.learning.setup import load_kernels
    from worker.tasks import find_task

    warp.config.log_level = warp.LOG_WARNING
    for algorithm in installed():
        load_kernels(find_algorithm(algorithm), Gang(RankPlacement(), "cpu", None, ["here"]))
    task = find_task(name)
    task(task.config_type(), 2, seed=1)
    (directory() / mark_of(task, "cpu")).mkdir(exist_ok=True)


def _sources() -> str:
    """A digest of all that the kernels of this clone are generated from; the cache's path holds the versions of libraries."""
    digest = hashlib.sha256()
    for package in ("worker", "racer"):
        for path in sorted((REPOSITORY / package).rglob("*")):
            if path.suffix in (".py", ".xml"):
                digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def main(names: Sequence[str]) -> int:
    """One process a task, since Warp compiles on one core, and as many at a time as there are cores; the worst exit code."""
    sources = _sources()

    def build(name: str) -> int:
        marker = CACHE / "built" / f"{name}-{sources}"
        if marker.exists():
            return 0
        code = subprocess.run([sys.executable, "-m", "tests.support.suite.kernels", "--one", name]).returncode
        if code == 0:
            marker.parent.mkdir(exist_ok=True)
            marker.touch()
        return code

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        return max(pool.map(build, names))


if __name__ == "__main__":
    if sys.argv[1:2] == ["--one"]:
        compile_for(sys.argv[2])
    else:
        tasks = {point.name for point in entry_points(group="muster.tasks")}
        sys.exit(main(sys.argv[1:] or [name for name in TASKS if name in tasks]))
