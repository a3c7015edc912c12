"""What engines need around them: a real Docker Engine, a Ray cluster, a Slurm cluster, a controller."""

from __future__ import annotations

import io
import tarfile
from collections.abc import Iterator
from typing import Any

import pytest

from shared_store import __version__
from tests.support.engines.images import PLAIN, SUPERVISED
from tests.support.engines.sites import SITES, Site
from tests.support.engines.slurm_cluster import SlurmCluster, started

pytest.register_assert_rewrite("tests.support.engines.every_engine")


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
    for name, changes in ((PLAIN, []), (SUPERVISED, [f"LABEL muster.version={__version__}"])):
        repository, _, tag = name.partition(":")
        client.api.import_image_from_data(empty.getvalue(), repository=repository, tag=tag, changes=changes)
    yield client
    client.close()


@pytest.fixture(scope="session")
def ray_cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """A head (drivers run there), and nodes ``n1``, ``n2`` and ``n3``, whose Python looks into ``modules`` first; environment variables lead to it."""
    pytest.importorskip("ray", reason="NO RAY: the ray engine is not tested (pip install 'muster[ray]')")
    from tests.support.engines.ray_cluster import RayCluster

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
def slurm_cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[SlurmCluster]:
    """slurmctld and three slurmd. ``SLURM_CONF`` is for the test to set: what inherits it counts as the cluster's."""
    with started(tmp_path_factory.mktemp("slurm")) as cluster:
        yield cluster


def sites(*names: str) -> Any:
    """A fixture ``site``: a controller with an engine, for each of the engines ``names`` in turn."""

    @pytest.fixture(scope="module", params=names)
    def site(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
        with SITES[request.param](tmp_path_factory.mktemp(request.param), request) as found:
            yield found

    return site
