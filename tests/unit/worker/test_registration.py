"""What Warp registers is read at its first use, and is the same code."""

from __future__ import annotations

import json
import subprocess
import sys

from tests.conftest import PATIENCE, REPOSITORY

HASHES = """
import ast, json, sys
import warp as wp
wp.config.enable_backward = False
if sys.argv[1] == "lazily":
    import worker.simulation
parsed = ast.parse
count = 0
def counting(*values, **named):
    global count
    count += 1
    return parsed(*values, **named)
ast.parse = counting
import mujoco_warp, newton
from newton.solvers import SolverMuJoCo
registered = count
modules = wp._src.context.user_modules
names = ("mujoco_warp._src.smooth", "mujoco_warp._src.solver", "newton._src.sim.articulation", "newton._src.solvers.mujoco.kernels")
found = {name: modules[name].get_module_hash(64).hex() for name in names}
print(json.dumps([registered, found]))
"""


def _hashes(how: str) -> tuple[int, dict[str, str]]:
    command = [sys.executable, "-W", "ignore", "-c", HASHES, how]
    done = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, timeout=60 * PATIENCE)
    assert done.returncode == 0, done.stderr
    parsed, found = json.loads(done.stdout.splitlines()[-1])
    return parsed, found


def test_functions_that_are_parsed_later_have_the_same_hashes() -> None:
    (lazily, found), (at_once, expected) = _hashes("lazily"), _hashes("at once")
    assert found == expected, "a kernel cache serves both"
    assert lazily < at_once / 3, "most functions are never parsed"
