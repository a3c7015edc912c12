"""A gang as AWS Batch's requests: a multi-node job definition, and a job of it. Pure."""

from __future__ import annotations

import hashlib
import json
import math
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from itertools import groupby
from typing import Any

from orchestrator.domain.gang import FARGATE_MEMBERS
from orchestrator.engines.api import EngineError, Gang, GangNode, NodePlan
from orchestrator.engines.aws_batch.config import AwsConfig
from shared_store import __version__
from shared_store.contract.node import sealed_in_image

DIGEST, GANG = "muster:digest", "muster:gang"
"""Tags: of a definition, of what it says; of a job, the attempt that it is."""
_MOST_NODES, _MOST_RANGES = 1000, 5
_TIMEOUT_SLACK = 600
"""Seconds after the controller's own timeout at which AWS ends an attempt whose controller is away."""
_OURS = ("vcpus", "memory", *FARGATE_MEMBERS)
"""Members of a container that are not passed on: the placement says the first two, and a job on EC2 must not have Fargate's."""
_NODE_FIELDS = ("node_index", "node_count", "main_index", "master_address", "address", "bus", "bus_token")


@dataclass(frozen=True)
class Requests:
    """The requests for one gang."""

    definition: Mapping[str, Any]
    """RegisterJobDefinition; the same for every attempt of a job of one size."""
    submission: Mapping[str, Any]
    """SubmitJob, without ``jobDefinition``."""
    supervised: tuple[bool, ...]
    """By node index: whether it runs under Muster's supervisor."""

    @property
    def digest(self) -> str:
        return str(self.definition["tags"][DIGEST])

    def document(self) -> str:
        """Both as JSON, to be read."""
        name = self.definition["jobDefinitionName"]
        shown = {
            "RegisterJobDefinition": self.definition,
            "SubmitJob": {**self.submission, "jobDefinition": f"{name}:<its revision>"},
        }
        return json.dumps(shown, indent=2)


def requests_for(gang: Gang, nodes: list[NodePlan], config: AwsConfig) -> Requests:
    """The requests of a gang. Raises EngineError where AWS can't run it.

    An image with Muster in it (``muster``, the stack's own, or whatever a job from YAML names) runs its command under the
    supervisor; any other one, of a job that came through the Batch API, runs it as it is.
    """
    if len(nodes) > _MOST_NODES:
        raise EngineError(f"{len(nodes)} nodes: AWS Batch takes at most {_MOST_NODES} in one job")
    plain = [not (gang.is_native or _has_muster(_image(node), config)) for node in gang.nodes]
    if missing := [index for index, each in enumerate(plain) if not each and not nodes[index].command]:
        raise EngineError(
            f"node {missing[0]} has no command, and that of image {_image(gang.nodes[missing[0]]) or 'muster'} can't be looked up at AWS to "
            "run it under Muster's supervisor; give it one"
        )
    ranges, overrides = [], []
    kinds = [
        (_container(gang, node, config, plain[index]), "" if plain[index] else _node(gang, node, config))
        for index, node in enumerate(nodes)
    ]
    for (container, description), group in groupby(range(len(nodes)), key=kinds.__getitem__):
        indices = list(group)
        target = {"targetNodes": f"{indices[0]}:{indices[-1]}"}
        ranges.append({**target, "container": container})
        if description:
            variable = {"name": "MUSTER_NODE", "value": description}
            overrides.append({**target, "containerOverrides": {"environment": [variable]}})
    if len(ranges) > _MOST_RANGES:
        raise EngineError(f"the nodes are of {len(ranges)} kinds; AWS Batch takes at most {_MOST_RANGES} in one job")
    definition: dict[str, Any] = {
        "jobDefinitionName": _name("muster-" + (gang.title or gang.job), 128),
        "type": "multinode",
        "nodeProperties": {"numNodes": len(nodes), "mainNode": gang.main, "nodeRangeProperties": ranges},
        "retryStrategy": {"attempts": 1},
        "propagateTags": True,
    }
    digest = hashlib.sha256(json.dumps(definition, sort_keys=True).encode()).hexdigest()[:32]
    definition["tags"] = {DIGEST: digest}
    # one name for each attempt, by which a job is found again if the controller died before it noted the submission
    submission: dict[str, Any] = {
        "jobName": _name((gang.title or "muster")[:50] + f"-{gang.job}-{gang.attempt}-{gang.epoch}", 128),
        "jobQueue": config.job_queue,
        "tags": {GANG: gang.name, "muster:run": gang.run},
    }
    if overrides:
        submission["nodeOverrides"] = {"nodePropertyOverrides": overrides}
    if gang.timeout:
        submission["timeout"] = {"attemptDurationSeconds": gang.timeout + _TIMEOUT_SLACK}
    if config.share:
        submission["shareIdentifier"] = config.share
        submission["schedulingPriorityOverride"] = gang.priority
    return Requests(definition, submission, tuple(not each for each in plain))


def _name(text: str, most: int) -> str:
    return re.sub(r"[^A-Za-z0-9_-]", "_", text).lstrip("_-")[:most]


def _has_muster(image: str, config: AwsConfig) -> bool:
    return image in ("", "muster") or _repository(image) == _repository(config.image)


def _repository(image: str) -> str:
    """An image's name without its tag or digest."""
    name = image.partition("@")[0]
    return name.rpartition(":")[0] if ":" in name.rpartition("/")[2] else name


def _image(node: GangNode) -> str:
    return str(node.container.get("image") or "")


def _container(gang: Gang, node: NodePlan, config: AwsConfig, plain: bool) -> dict[str, Any]:
    """``containerProperties`` of a node: the job's own, with what Muster needs."""
    described, placement = gang.nodes[node.contract.node_index], node.placement
    own, image = described.container, _image(described)
    resources = [
        {"type": "VCPU", "value": str(max(1, math.ceil(placement.cpus)))},
        {"type": "MEMORY", "value": str(placement.memory)},
    ]
    if placement.gpus:
        resources.append({"type": "GPU", "value": str(len(placement.gpus))})
    container: dict[str, Any] = {
        **{key: value for key, value in own.items() if key not in _OURS and value not in ([], {}, None)},
        "image": config.image if image in ("", "muster") else image,
        "resourceRequirements": resources,
        "command": list(node.command) if plain else ["python", "-P", "-m", "worker.aws_node", "--", *node.command],
        "environment": _pairs(node.environment if plain else _supervised(node.environment, config)),
    }
    if plain and not node.command:
        del container["command"]  # the image's own runs
    linux = {"sharedMemorySize": max(64, placement.memory // 2), **(own.get("linuxParameters") or {})}
    if config.efa:
        device = {"hostPath": "/dev/infiniband/uverbs0", "containerPath": "/dev/infiniband/uverbs0"}
        linux["devices"] = [*(linux.get("devices") or []), {**device, "permissions": ["READ", "WRITE", "MKNOD"]}]
        unlimited = {"name": "memlock", "softLimit": -1, "hardLimit": -1}
        container["ulimits"] = [*(own.get("ulimits") or []), unlimited]
    container["linuxParameters"] = linux
    container.setdefault("logConfiguration", {"logDriver": "awslogs", "options": {"awslogs-group": config.log_group}})
    if config.job_role:
        container.setdefault("jobRoleArn", config.job_role)
    if config.instance_type:
        container.setdefault("instanceType", config.instance_type)
    if config.file_system and not plain:
        volume, mount = _volume(config)
        container["volumes"] = [*(own.get("volumes") or []), volume]
        container["mountPoints"] = [*(own.get("mountPoints") or []), mount]
    return container


def _volume(config: AwsConfig) -> tuple[dict[str, Any], dict[str, Any]]:
    efs: dict[str, Any] = {"fileSystemId": config.file_system, "transitEncryption": "ENABLED"}
    if config.access_point:
        efs["authorizationConfig"] = {"accessPointId": config.access_point, "iam": "ENABLED"}
    else:
        efs["rootDirectory"] = "/"
    mount = {"sourceVolume": "muster-store", "containerPath": config.store, "readOnly": False}
    return {"name": "muster-store", "efsVolumeConfiguration": efs}, mount


def _supervised(environment: Mapping[str, str], config: AwsConfig) -> dict[str, str]:
    """Muster's own variables travel as one: on whatever plays AWS they must not be taken for its own. The rest is the ranks' alone."""
    own = {name: value for name, value in environment.items() if name.startswith("MUSTER_")}
    rest = {name: value for name, value in environment.items() if name not in own}
    kernels = {"WARP_CACHE_PATH": f"{config.store}/kernels"}  # compiled once a kind of GPU, not once an instance
    return {**sealed_in_image(kernels | rest, {}), "MUSTER_ENVIRONMENT": json.dumps(own, separators=(",", ":"))}


def _node(gang: Gang, node: NodePlan, config: AwsConfig) -> str:
    """``MUSTER_NODE``: of the contract all that a node can't know by itself, and the run's description."""
    contract = {key: value for key, value in asdict(node.contract).items() if key not in _NODE_FIELDS}
    contract["store"] = config.store
    description = {"run": gang.run, "job": gang.job, "version": __version__, "name": gang.title}
    return json.dumps({"contract": contract, "description": description}, separators=(",", ":"))


def _pairs(environment: Mapping[str, str]) -> list[dict[str, str]]:
    return [{"name": name, "value": value} for name, value in environment.items()]
