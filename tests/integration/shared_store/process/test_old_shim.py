"""A shim of an older commit, whose code is replaced under it while its node runs: it loads modules only when the node ends."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.conftest import REPOSITORY
from tests.support.former.environment import COMMIT, is_in_history, make_environment
from tests.support.processes import alive, await_end
from tests.support.waiting import wait_for

SUPERVISOR = """
import os, subprocess, sys, time
left = subprocess.Popen(["sleep", "600"], start_new_session=True)
with open("left.new", "w") as file: file.write(str(left.pid))
os.rename("left.new", "left")
while not os.path.exists("end"): time.sleep(0.02)
sys.exit(7)
"""


@pytest.mark.skipif(
    not is_in_history(), reason=f"this checkout's history lacks commit {COMMIT}, whose shim is untested"
)
def test_it_ends_what_the_node_leaves_behind(tmp_path: Path) -> None:
    make_environment(tmp_path)
    package = tmp_path / "code" / "shared_store"
    command = [sys.executable, "-I", "-S", str(package / "shim.py"), "0", "", "0", sys.executable, "-c", SUPERVISOR]
    with subprocess.Popen(command, cwd=tmp_path) as shim:
        left = int(wait_for(lambda: (tmp_path / "left").exists() and (tmp_path / "left").read_text()))
        shutil.rmtree(package)
        shutil.copytree(REPOSITORY / "shared_store", package)
        assert alive(left)
        (tmp_path / "end").touch()
        assert shim.wait(120) == 7
    await_end(left)
