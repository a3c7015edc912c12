"""A real Docker Engine, and images made of nothing but this machine's own files, mounted read-only: no registry is needed."""

from __future__ import annotations

import io
import sys
import tarfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.conftest import REPOSITORY

PLAIN, SUPERVISED = "muster-test-plain:1", "muster-test:1"
"""An empty image, and one that says that Muster is in it."""


@pytest.fixture(scope="session")
def docker_client() -> Iterator[Any]:
    docker = pytest.importorskip("docker")
    try:
        client = docker.from_env(timeout=60)
        client.ping()
    except Exception as error:
        pytest.skip(f"NO DOCKER ENGINE: the docker engine is not tested ({error})")
    empty = io.BytesIO()
    with tarfile.open(fileobj=empty, mode="w") as tar:
        scratch = tarfile.TarInfo("tmp")
        scratch.type, scratch.mode = tarfile.DIRTYPE, 0o1777
        tar.addfile(scratch)
    for name, changes in ((PLAIN, []), (SUPERVISED, ["LABEL muster.version=test"])):
        repository, _, tag = name.partition(":")
        client.api.import_image_from_data(empty.getvalue(), repository=repository, tag=tag, changes=changes)
    yield client
    client.close()


def host_files() -> dict[str, Any]:
    """``containerProperties`` with which an empty image has this machine's programs, Python and this repository."""
    needed = {
        "/usr",
        "/bin",
        "/lib",
        "/lib64",
        "/etc",
        str(REPOSITORY),
        sys.base_prefix,
        str(Path(sys.executable).parent.parent),
    }
    paths = sorted(path for path in needed if Path(path).is_dir())
    paths = [path for path in paths if not any(path != other and path.startswith(f"{other}/") for other in paths)]
    return {
        "volumes": [{"name": f"v{number}", "host": {"sourcePath": path}} for number, path in enumerate(paths)],
        "mountPoints": [
            {"sourceVolume": f"v{number}", "containerPath": path, "readOnly": True} for number, path in enumerate(paths)
        ],
    }


PATH = f"{Path(sys.executable).parent}:/usr/local/bin:/usr/bin:/bin"


@pytest.fixture(scope="session")
def ray_cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """A head (drivers run there), and nodes ``n1``, ``n2`` and ``n3``, whose Python looks into ``modules`` first; environment variables lead to it."""
    pytest.importorskip("ray", reason="NO RAY: the ray engine is not tested (pip install 'muster[ray]')")
    from tests.engines.ray_cluster import RayCluster

    cluster = RayCluster(tmp_path_factory.mktemp("ray"))
    with pytest.MonkeyPatch.context() as patch:
        for name, value in cluster.variables.items():
            patch.setenv(name, value)
        try:
            cluster.add("n1", "n2")
            cluster.add("n3", PYTHONPATH=str(cluster.modules))
            yield cluster
        finally:
            cluster.close()


@pytest.fixture(scope="session")
def slurm_cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """slurmctld and three slurmd. ``SLURM_CONF`` is for the test to set: what inherits it counts as the cluster's."""
    from tests.engines.slurm_cluster import SlurmCluster, need_slurm

    need_slurm()
    cluster = SlurmCluster(tmp_path_factory.mktemp("slurm"))
    try:
        cluster.start()
        cluster.ready()
        yield cluster
    finally:
        cluster.close()
    assert not cluster.processes()
