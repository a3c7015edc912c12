"""``make cluster`` up to Docker, of which a double writes down what it was asked; ``make push`` into a registry of its own."""

from __future__ import annotations

import json
import os
import shutil
import socket
import subprocess
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.conftest import REPOSITORY, wait_for
from tests.support.worker.ranks import free_port

CONFIGURATION = """
version: 0.1
storage: {{filesystem: {{rootdirectory: {root}}}}}
http: {{addr: "127.0.0.1:{port}"}}
"""


@pytest.fixture
def registry(tmp_path: Path) -> Iterator[str]:
    """Host and port of a real registry."""
    if not shutil.which("docker-registry"):
        pytest.skip("NO docker-registry: make push is not tested")
    port = free_port()
    (tmp_path / "config.yml").write_text(CONFIGURATION.format(root=tmp_path / "images", port=port))
    command = ["docker-registry", "serve", str(tmp_path / "config.yml")]
    serving = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)

    def answers() -> bool:
        try:
            return bool(urllib.request.urlopen(f"http://127.0.0.1:{port}/v2/", timeout=2))
        except OSError:
            return False

    wait_for(answers, 20, "the registry")
    yield f"127.0.0.1:{port}"
    serving.kill()
    serving.wait()


def make(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(["make", "push", *arguments], cwd=REPOSITORY, capture_output=True, text=True, timeout=120)


def test_the_image_is_pushed_under_its_version_and_latest(registry: str, docker_client: Any) -> None:
    image = {"repository": "muster-test-push", "tag": "1"}
    labels = ["LABEL org.opencontainers.image.version=1.2.3"]
    docker_client.api.import_image_from_data(b"\0" * 10240, **image, changes=labels)
    done = make(f"REGISTRY={registry}/robots", "IMAGE=muster-test-push:1")
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.count("digest: sha256:") == 2
    with urllib.request.urlopen(f"http://{registry}/v2/robots/muster/tags/list", timeout=10) as answer:
        assert sorted(json.load(answer)["tags"]) == ["1.2.3", "latest"]
    for tag in ("1.2.3", "latest"):
        docker_client.images.remove(f"{registry}/robots/muster:{tag}")
    docker_client.images.remove("muster-test-push:1")


@pytest.mark.usefixtures("docker_client")
def test_a_missing_registry_or_image_is_reported_in_one_line() -> None:
    for arguments, output in (
        ((), "make push needs REGISTRY, such as REGISTRY=registry.example.com:5000/robots"),
        (("REGISTRY=r", "IMAGE=muster-test-no-such"), "there is no image muster-test-no-such; make image builds it"),
    ):
        refused = make(*arguments)
        assert refused.returncode != 0 and refused.stderr.splitlines()[0] == output


# -- make cluster -------------------------------------------------------------------------------------------------------

DOUBLE = """#!/bin/sh
echo "MUSTER_IMAGE=$MUSTER_IMAGE docker $*" >>"$CALLS"
"""


def make_cluster(folder: Path, *arguments: str) -> tuple[subprocess.CompletedProcess[str], list[str]]:
    """``make cluster`` in ``folder``, and the commands that Docker was given."""
    double = folder / "bin" / "docker"
    if not double.exists():
        double.parent.mkdir()
        double.write_text(DOUBLE)
        double.chmod(0o755)
        (folder / "Makefile").symlink_to(REPOSITORY / "Makefile")
    reported = folder / "calls"
    reported.write_text("")
    env = {**os.environ, "PATH": f"{double.parent}:{os.environ['PATH']}", "CALLS": str(reported)}
    command = ["make", "cluster", *arguments]
    done = subprocess.run(command, cwd=folder, env=env, capture_output=True, text=True, timeout=120)
    return done, reported.read_text().splitlines()


@pytest.mark.parametrize("kept", [False, True], ids=["on the command line", "in the cluster's environment"])
def test_a_port_in_use_is_reported_before_anything_starts(tmp_path: Path, kept: bool) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        if kept:
            (tmp_path / ".cluster").mkdir()
            (tmp_path / ".cluster" / "environment").write_text(f"MUSTER_TOKEN=x\nMUSTER_PORT={port}\n")
        done, reported = make_cluster(tmp_path, *([] if kept else [f"MUSTER_PORT={port}"]))
    assert done.returncode != 0
    output = done.stderr.splitlines()[0]
    assert output.startswith(f"port {port} of this machine is taken") and "make cluster MUSTER_PORT=" in output
    assert not [line for line in reported if " build " in line or " up " in line]


def test_the_image_is_always_built_with_ray_and_is_the_one_that_runs(tmp_path: Path) -> None:
    port = free_port()
    for _ in range(2):  # an image of that name is there the second time
        done, reported = make_cluster(tmp_path, "IMAGE=robots:2", f"MUSTER_PORT={port}")
        assert done.returncode == 0, done.stdout + done.stderr
        [build] = [line for line in reported if " build " in line]
        assert "-t robots:2 " in build and "EXTRAS=worker,ray" in build
        [up] = [line for line in reported if " up " in line]
        assert up.startswith("MUSTER_IMAGE=robots:2 docker compose ") and reported.index(build) < reported.index(up)
        assert f"MUSTER_URL=http://127.0.0.1:{port} MUSTER_TOKEN=" in done.stdout
