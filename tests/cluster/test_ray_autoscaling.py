"""A Ray cluster that is too small: the job waits and says why, the autoscaler adds machines for it and takes idle ones away again.

Ray's fake provider (machines that are processes on this one) with autoscaler v1.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from orchestrator.engines.toolkit.statuses import status_of
from tests.conftest import REPOSITORY, wait_for
from tests.support.engines.ray_bench import RayBench
from tests.support.engines.ray_cluster import RayCluster
from tests.support.worker.ranks import free_port

pytest.importorskip("ray", reason="NO RAY: the ray engine is not tested (pip install 'muster[ray]')")


_HEAD = "f" * 51 + "00000"


@pytest.fixture
def growing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[RayCluster]:
    """A head that may add two machines with one CPU and 1 GiB each, and takes them away after six idle seconds."""
    port = free_port()
    config = {
        "cluster_name": "growing",
        "max_workers": 2,
        "idle_timeout_minutes": 0.1,
        "upscaling_speed": 1.0,
        "provider": {
            "type": "external",
            "module": "tests.support.engines.ray_provider.Provider",
            "use_node_id_as_ip": True,
            "disable_launch_config_check": True,
            "disable_node_updaters": True,
            "head_node_id": _HEAD,
            "gcs_address": f"{RayCluster.network()}.1:{port}",
        },
        "auth": {},
        "head_node_type": "ray.head.default",
        "available_node_types": {
            "ray.head.default": {"resources": {"CPU": 0}, "node_config": {}, "max_workers": 0},
            "small": {
                "resources": {"CPU": 1, "memory": 2**30, "object_store_memory": 80_000_000},
                "node_config": {},
                "min_workers": 0,
                "max_workers": 2,
            },
        },
        "docker": {},
        "initialization_commands": [],
        "setup_commands": [],
        "head_setup_commands": [],
        "worker_setup_commands": [],
        "head_start_ray_commands": [],
        "worker_start_ray_commands": [],
        "file_mounts": {},
        "cluster_synced_files": [],
        "file_mounts_sync_continuously": False,
        "rsync_exclude": [],
        "rsync_filter": [],
    }
    (tmp_path / "autoscaling.json").write_text(json.dumps(config))
    cluster = RayCluster(
        tmp_path,
        (f"--autoscaling-config={tmp_path / 'autoscaling.json'}",),
        port,
        RAY_FAKE_CLUSTER="1",
        PYTHONPATH=str(REPOSITORY),
        AUTOSCALER_UPDATE_INTERVAL_S="1",
        RAY_OVERRIDE_NODE_ID_FOR_TESTING=_HEAD,
    )
    for name, value in cluster.variables.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setenv("MUSTER_RAY_GROWS_TO", "2*{cpus:1,memory:1GiB}")
    yield cluster
    cluster.close()


def test_machines_are_asked_for_come_and_go(growing: RayCluster, tmp_path: Path) -> None:
    bench = RayBench(growing, tmp_path)

    def names() -> list[str]:
        return [host.name for host in bench.engine.capacity().machines]

    def machines() -> int:
        return sum(1 for node in bench.engine._watch.seen["nodes"] if node["cpus"])

    try:
        assert names() == ["ray/+1", "ray/+2"], "what may be added is there to be planned with"
        handle = bench.launch(bench.gang(hosts=("+1", "+2"), cpus=1.0))
        reason = "waits for 2 more nodes with 1 CPUs, 256 MiB: Ray's autoscaler was asked"
        wait_for(lambda: [node.words for node in status_of(bench.engine, handle)] == [reason] * 2, 30, "it says why")
        wait_for(lambda: bench.log().count("ready") == 2, 90, f"machines come: {status_of(bench.engine, handle)}")
        assert sorted(names()) == ["ray/+1", "ray/+2"], "as long as it runs there, they are called as it was planned"
        # The watch looks once a second: what has printed may have a machine that it has not seen yet.
        wait_for(lambda: machines() == 2, 30, "each node came on a machine of its own")
        bench.engine.stop(handle, 1.0)
        bench.engine._let_go("")
        wait_for(lambda: machines() == 0, 90, "idle machines go")
        assert names() == ["ray/+1", "ray/+2"]
    finally:
        bench.close()
    assert os.environ["RAY_ADDRESS"] == growing.address
