"""``make push``: the image under its version and ``latest``, in a registry of its own."""

from __future__ import annotations

import json
import shutil
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
    serving = subprocess.Popen(
        ["docker-registry", "serve", str(tmp_path / "config.yml")], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )

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
    docker_client.api.import_image_from_data(
        b"\0" * 10240, repository="muster-test-push", tag="1", changes=["LABEL org.opencontainers.image.version=1.2.3"]
    )
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
    for arguments, said in (
        ((), "make push needs REGISTRY, such as REGISTRY=registry.example.com:5000/robots"),
        (("REGISTRY=r", "IMAGE=muster-test-no-such"), "there is no image muster-test-no-such; make image builds it"),
    ):
        refused = make(*arguments)
        assert refused.returncode != 0 and refused.stderr.splitlines()[0] == said
