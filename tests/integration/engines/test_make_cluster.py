"""``make cluster`` up to Docker: a double of ``docker`` writes down what it was asked."""

from __future__ import annotations

import os
import socket
import subprocess
from pathlib import Path

import pytest

from tests.conftest import REPOSITORY
from tests.support.worker.ranks import free_port

DOUBLE = """#!/bin/sh
echo "MUSTER_IMAGE=$MUSTER_IMAGE docker $*" >>"$TOLD"
"""


def make_cluster(folder: Path, *arguments: str) -> tuple[subprocess.CompletedProcess[str], list[str]]:
    """``make cluster`` in ``folder``, and the commands that Docker was given."""
    double = folder / "bin" / "docker"
    if not double.exists():
        double.parent.mkdir()
        double.write_text(DOUBLE)
        double.chmod(0o755)
        (folder / "Makefile").symlink_to(REPOSITORY / "Makefile")
    told = folder / "told"
    told.write_text("")
    env = {**os.environ, "PATH": f"{double.parent}:{os.environ['PATH']}", "TOLD": str(told)}
    done = subprocess.run(
        ["make", "cluster", *arguments], cwd=folder, env=env, capture_output=True, text=True, timeout=120
    )
    return done, told.read_text().splitlines()


@pytest.mark.parametrize("kept", [False, True], ids=["on the command line", "in the cluster's environment"])
def test_a_port_in_use_is_reported_before_anything_starts(tmp_path: Path, kept: bool) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        if kept:
            (tmp_path / ".cluster").mkdir()
            (tmp_path / ".cluster" / "environment").write_text(f"MUSTER_TOKEN=x\nMUSTER_PORT={port}\n")
        done, told = make_cluster(tmp_path, *([] if kept else [f"MUSTER_PORT={port}"]))
    assert done.returncode != 0
    said = done.stderr.splitlines()[0]
    assert said.startswith(f"port {port} of this machine is taken") and "make cluster MUSTER_PORT=" in said
    assert not [line for line in told if " build " in line or " up " in line]


def test_the_image_is_always_built_with_ray_and_is_the_one_that_runs(tmp_path: Path) -> None:
    port = free_port()
    for _ in range(2):  # an image of that name is there the second time
        done, told = make_cluster(tmp_path, "IMAGE=robots:2", f"MUSTER_PORT={port}")
        assert done.returncode == 0, done.stdout + done.stderr
        [build] = [line for line in told if " build " in line]
        assert "-t robots:2 " in build and "EXTRAS=worker,ray" in build
        [up] = [line for line in told if " up " in line]
        assert up.startswith("MUSTER_IMAGE=robots:2 docker compose ") and told.index(build) < told.index(up)
        assert f"MUSTER_URL=http://127.0.0.1:{port} MUSTER_TOKEN=" in done.stdout
