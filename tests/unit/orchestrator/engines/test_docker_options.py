"""What a job definition says of a container, as options of Docker."""

from __future__ import annotations

import pytest

from orchestrator.domain.hosts import Placement
from orchestrator.engines.api import EngineError, NodePlan
from orchestrator.engines.docker.engine import _addresses
from orchestrator.engines.docker.request import limits, linux
from tests.support.worker.node import node_contract


def test_a_container_has_the_file_systems_devices_and_rights_that_its_definition_names() -> None:
    container = {
        "linuxParameters": {
            "initProcessEnabled": True,
            "tmpfs": [
                {"containerPath": "/tmp", "size": 64},
                {"containerPath": "/run", "size": 8, "mountOptions": ["ro"]},
            ],
            "devices": [
                {"hostPath": "/dev/fuse", "permissions": ["READ", "WRITE"]},
                {"hostPath": "/a", "containerPath": "/b"},
            ],
        },
        "user": "1000",
        "privileged": True,
        "readonlyRootFilesystem": True,
    }
    assert linux(container) == {
        "init": True,
        "tmpfs": {"/tmp": "size=64m", "/run": "size=8m,ro"},
        "devices": ["/dev/fuse:/dev/fuse:rw", "/a:/b:rwm"],
        "user": "1000",
        "privileged": True,
        "read_only": True,
    }
    assert linux({}) == {"init": False}


def test_a_node_has_the_gpus_cores_and_memory_of_its_placement() -> None:
    node = NodePlan(node_contract(None, None), [], {}, Placement("docker/a", ("2", "5"), 8.0, 1000))
    found = limits({"linuxParameters": {"maxSwap": 24}}, node, cores=4.0)
    [request] = found.pop("device_requests")
    assert request["DeviceIDs"] == ["2", "5"] and request["Capabilities"] == [["gpu"]]
    assert found == {
        "nano_cpus": 4_000_000_000,
        "mem_limit": "1000m",
        "shm_size": "500m",
        "memswap_limit": "1024m",
        "mem_swappiness": 60,
        "ulimits": [],
    }


def test_a_network_of_a_gang_has_room_for_250_nodes() -> None:
    assert _addresses("10.1.2.0/24", 250)[-1] == "10.1.2.251"
    with pytest.raises(EngineError, match="251 nodes: the docker engine has room for 250"):
        _addresses("10.1.2.0/24", 251)
