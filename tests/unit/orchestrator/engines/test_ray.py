"""Ray: the placement group of ``--dry-run``, and ``containers/ray/`` by Ray's own schema and KubeRay's structure."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest
import yaml

from orchestrator.engines.ray.cluster import grows_to
from orchestrator.engines.ray.placement_groups import in_words
from tests.conftest import REPOSITORY


def test_the_plan_shows_the_requested_placement_group() -> None:
    node = {"cpus": 1.5, "gpus": 1, "memory": 256, "host": "ray/n1", "pin": "abc"}
    new = {"cpus": 1.0, "gpus": 0, "memory": 64, "host": "ray/+1", "pin": None}
    assert in_words({"main": 0, "nodes": [node, new]}) == (
        "# an actor on each bundle starts the node's supervisor\n"
        "ray.util.placement_group(\n"
        "  [\n"
        '    {"CPU": 1.5, "memory": 268435456, "GPU": 1},  # node 0, the main node, on ray/n1\n'
        '    {"CPU": 1.0, "memory": 67108864},  # node 1, on ray/+1, a machine that the autoscaler is asked for\n'
        "  ],\n"
        '  strategy="STRICT_SPREAD",\n'
        "  bundle_label_selector=[\n"
        '    {"ray.io/node-id": "abc"},\n'
        "    {},\n"
        "  ],\n"
        ")"
    )


MANIFESTS = REPOSITORY / "containers" / "ray"


def load(name: str) -> dict[str, Any]:
    found: dict[str, Any] = yaml.safe_load((MANIFESTS / name).read_text())
    return found


def test_the_launcher_s_file_holds_ray_s_own_schema_and_muster_knows_how_far_it_grows() -> None:
    ray = pytest.importorskip("ray", reason="NO RAY: its schema is not there")
    import jsonschema

    config = load("cluster.yaml")
    schema = json.loads((Path(ray.__file__).parent / "autoscaler" / "ray-schema.json").read_text())
    jsonschema.validate(config, schema)
    types = config["available_node_types"]
    assert config["head_node_type"] in types
    text = " ".join(config["head_start_ray_commands"])
    reported = re.search(r"MUSTER_RAY_GROWS_TO='([^']+)'", text)
    assert reported
    [shape] = grows_to(reported[1])
    resources = types["gpu"]["resources"]
    found = (resources["CPU"], resources["GPU"], types["gpu"]["max_workers"])
    assert (shape["cpus"], shape["gpus"], shape["most"]) == found
    assert shape["memory"] == resources["memory"] // 2**20
    assert f"--num-cpus={types['head']['resources']['CPU']}" in text
    assert "--env=RAY_AUTH_MODE=token" in config["docker"]["run_options"]


def test_the_image_has_what_ray_s_launcher_needs_in_it() -> None:
    """``bash --login`` for every command, rsync into the container, ssh and boto3 on the head, and a volume that its user may write."""
    config, text = load("cluster.yaml"), (MANIFESTS / "cluster.yaml").read_text()
    dockerfile = (REPOSITORY / "containers" / "Dockerfile").read_text()
    packages = re.search(r"apt-get install -y --no-install-recommends (.*?) \\\n", dockerfile)
    assert packages and {"openssh-client", "rsync"} <= set(packages[1].split())
    path = re.search(r"^ENV PATH=(\S+):\$PATH", dockerfile, re.MULTILINE)
    assert path and f"echo 'export PATH={path[1]}:$PATH' >/etc/profile.d/muster.sh" in dockerfile
    assert "EXTRAS=worker,ray,aws" in text
    commands = config["initialization_commands"]
    mounting = next(index for index, command in enumerate(commands) if "mount -t nfs4" in command)
    image = config["docker"]["image"]
    assert f"sudo chown $(docker run --rm {image} id -u) /muster /muster/ray-token" in commands[mounting + 1 :]


def test_the_kuberay_manifest_is_a_raycluster_whose_nodes_share_token_and_volume() -> None:
    manifest = load("raycluster.yaml")
    assert (manifest["apiVersion"], manifest["kind"]) == ("ray.io/v1", "RayCluster")
    spec = manifest["spec"]
    known = {"rayVersion", "enableInTreeAutoscaling", "autoscalerOptions", "headGroupSpec", "workerGroupSpecs"}
    assert spec.keys() <= known
    assert f"ray=={spec['rayVersion']}" in (REPOSITORY / "constraints.txt").read_text().splitlines()
    assert spec["headGroupSpec"].keys() == {"rayStartParams", "template"}
    group = {"groupName", "replicas", "minReplicas", "maxReplicas", "rayStartParams", "template"}
    assert all(each.keys() == group for each in spec["workerGroupSpecs"])
    assert manifest["metadata"]["annotations"]["ray.io/overwrite-container-cmd"] == "true"
    for each in [spec["headGroupSpec"], *spec["workerGroupSpecs"]]:
        assert all(isinstance(value, str) for value in each["rayStartParams"].values())
        pod = each["template"]["spec"]
        volumes = {volume["name"] for volume in pod["volumes"]}
        [container] = pod["containers"]
        variables = {variable["name"] for variable in container["env"]}
        assert {"RAY_AUTH_MODE", "RAY_AUTH_TOKEN"} <= variables
        assert {mount["name"] for mount in container["volumeMounts"]} <= volumes and "muster" in volumes
        assert "$KUBERAY_GEN_RAY_START_CMD" in container["args"][0]
        assert pod["terminationGracePeriodSeconds"] > 30, "a node that has to leave drains for 30 s"
    head = spec["headGroupSpec"]["template"]["spec"]["containers"][0]
    assert {"name": "RAY_gcs_storage", "value": "rocksdb"} in head["env"]
