"""Watches a Ray cluster for the engine: a line of JSON each second, ``{"nodes": […], "grows": […], "join": ADDRESS}`` or ``{"error": WHY}``.

``python -m orchestrator.engines.ray.cluster_watch HOST:PORT``. A process of its own: Ray aborts one that loses its cluster. It reads the
head's tables and is no part of the cluster. It ends when its standard input does, which is when the controller does.
"""

from __future__ import annotations

import json
import os
import platform
import select
import socket
import sys
from collections.abc import Mapping
from typing import Any

import ray
from ray._private.state import GlobalState
from ray._raylet import GcsClient, GcsClientOptions


class NotUsable(Exception):
    """The cluster can't be used; one line with what to do."""


def check(address: str) -> None:
    """Raises NotUsable where the head at ``address`` does not answer, does not let us in, or runs another version."""
    host, _, port = address.rpartition(":")
    try:
        socket.create_connection((host, int(port)), timeout=5.0).close()
    except OSError as error:
        raise NotUsable(
            f"no Ray head answers at {address} ({error.strerror or error}); set RAY_ADDRESS to its host:port"
        ) from error
    try:
        metadata = GcsClient(address=address).internal_kv_get(b"CLUSTER_METADATA", b"cluster", timeout=10)
    except ray.exceptions.AuthenticationError as error:
        mode = os.environ.get("RAY_AUTH_MODE")
        ours = "another one is set here" if mode == "token" else "none is set here"
        raise NotUsable(
            f"the Ray cluster at {address} wants its token, and {ours}: RAY_AUTH_MODE=token with RAY_AUTH_TOKEN_PATH or RAY_AUTH_TOKEN"
        ) from error
    except Exception as error:
        raise NotUsable(f"{address} is not a healthy Ray head ({str(error).strip().splitlines()[0]})") from error
    cluster = json.loads(metadata or b"{}")
    python = platform.python_version()
    theirs = cluster.get("ray_version"), str(cluster.get("python_version")).rpartition(".")[0]
    if theirs != (ray.__version__, python.rpartition(".")[0]):
        raise NotUsable(
            f"the Ray cluster at {address} runs Ray {theirs[0]} on Python {theirs[1]}, this is Ray {ray.__version__} on Python "
            f"{python}: run Muster from an environment with the cluster's versions"
        )


def report(state: GlobalState) -> dict[str, Any]:
    """The cluster as it is."""
    draining = state.get_draining_nodes()
    nodes = [
        {
            "id": node["NodeID"],
            "name": node["NodeName"] or node["NodeManagerAddress"],
            "address": node["NodeManagerAddress"],
            "port": node["NodeManagerPort"],
            "head": "node:__internal_head__" in node["Resources"],
            **_shape(node["Resources"]),
        }
        for node in state.node_table()
        if node["Alive"] and node["NodeID"] not in draining
    ]
    here = [node for node in nodes if _is_here(node["address"], node["port"])]
    # best a node that was made for it (`--num-cpus 0`), and not the head, whose end would be that of the drivers
    here.sort(key=lambda node: (node["cpus"] > 0, node["head"], node["address"]))
    config = state.get_cluster_config()
    groups = config.node_group_configs if config else ()
    grows = [{**_shape(group.resources), "most": group.max_count} for group in groups]
    return {"nodes": nodes, "grows": grows, "join": here[0]["address"] if here else None}


def _shape(resources: Mapping[str, float]) -> dict[str, float]:
    """CPUs, GPUs and memory [MiB]."""
    memory = int(resources.get("memory", 0.0) / 2**20)
    return {"cpus": resources.get("CPU", 0.0), "gpus": int(resources.get("GPU", 0.0)), "memory": memory}


def _is_here(address: str, port: int) -> bool:
    """Whether the address is one of this machine's, and a raylet listens there: the head believes in a dead one for a while."""
    with socket.socket(socket.AF_INET6 if ":" in address else socket.AF_INET) as probe:
        try:
            probe.bind((address, 0))
            probe.settimeout(1.0)
            probe.connect((address, port))
            return True
        except OSError:
            return False


def main(address: str) -> int:
    """Until the controller leaves. Exit code 1: the cluster can't be used, as the last line says."""
    try:
        check(address)
        state = GlobalState()
        state._initialize_global_state(GcsClientOptions.create(address, None, True, False))
        while True:
            print(json.dumps(report(state)), flush=True)
            if select.select([sys.stdin], [], [], 1.0)[0]:
                return 0
    except NotUsable as error:
        print(json.dumps({"error": str(error)}), flush=True)
    except ray.exceptions.RaySystemError:
        print(json.dumps({"error": f"the Ray head at {address} does not answer"}), flush=True)
    return 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
