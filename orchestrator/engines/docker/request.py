"""The request to Docker for one node of a gang: complete but for the contents of the image, which only Docker knows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from docker.types import DeviceRequest, Mount, Ulimit

from orchestrator.engines.api import Gang, NodePlan
from orchestrator.engines.toolkit.mounts import mounts_of
from shared_store.contract.node import BUS_VARIABLES, NodeContract, sealed_in_image

STORE, KERNELS = "/muster/store", "/muster/kernels"
"""Paths of the store and of the cache of compiled kernels in a container of an image with Muster."""
GANG, NODE, PLAIN = "muster.gang", "muster.node", "muster.plain"
"""Labels of containers and networks: whose they are, and whether they run without a supervisor."""
_PERMISSIONS = {"READ": "r", "WRITE": "w", "MKNOD": "m"}
"""Of devices, and their letters in Docker."""


@dataclass(frozen=True)
class ContainerRequest:
    """One node's container."""

    image: str
    name: str
    hostname: str
    command: Sequence[str]
    environment: Mapping[str, str]
    """The job's own."""
    contract: NodeContract
    mounts: Sequence[Mount]
    """The job's own."""
    options: Mapping[str, Any]
    """Limits, devices and the like."""
    store: str
    """Directory of the shared volume on this machine."""

    def at(self, address: str, main: str) -> ContainerRequest:
        """The same on another network: the node's address, and the main node's."""
        return replace(self, contract=replace(self.contract, address=address, master_address=main))

    def arguments(self, entrypoint: Sequence[str], default: Sequence[str], kernels: Path | None) -> dict[str, Any]:
        """Of Docker's ``create``, less the network. Raises OSError where the store can't be seen.

        Args:
            entrypoint: The image's own.
            default: Its ``CMD``, for a job that has no command. Docker takes it by itself only where no entrypoint is passed either.
            kernels: Directory for compiled kernels; None for an image without Muster, whose command runs without a supervisor.
        """
        contract = self.contract.to_env()
        own = list(self.command or default)
        node = str(self.contract.node_index)
        arguments: dict[str, Any] = {
            "name": self.name,
            "hostname": self.hostname,
            "labels": {GANG: self.contract.gang, NODE: node, PLAIN: "1" if kernels is None else ""},
            **self.options,
        }
        if kernels is None:
            environment = {**self.environment, **contract}
            environment = {name: value for name, value in environment.items() if name not in BUS_VARIABLES}
            mounts, entry, command = [*self.mounts], list(entrypoint) or None, own
        else:
            job = {"HOME": "/tmp", "WARP_CACHE_PATH": KERNELS, **self.environment}
            environment = {"HOME": "/tmp", **sealed_in_image(job, contract)}
            mounts = [*self.mounts, Mount(STORE, self.store, "bind"), Mount(KERNELS, str(kernels), "bind")]
            # whoever owns the store writes it; that is seldom the user that the image names
            owner = Path(self.store).stat()
            arguments.setdefault("user", f"{owner.st_uid}:{owner.st_gid}")
            entry = ["python", "-P", "-m", "worker.supervisor", "--"]
            command = [*entrypoint, *own]
        return {**arguments, "command": command, "entrypoint": entry, "environment": environment, "mounts": mounts}


def container_request(gang: Gang, node: NodePlan, cores: float) -> ContainerRequest:
    """The request for one node of ``gang``; ``cores``: of the machine."""
    index = node.contract.node_index
    container = gang.nodes[index].container
    return ContainerRequest(
        image=str(container.get("image") or ""),
        name=f"muster-{gang.name.replace('/', '-')}-{index}",
        hostname=f"node-{index}",
        command=tuple(node.command),
        environment=node.environment,
        contract=node.contract,
        mounts=[Mount(m.target, m.source, "bind", read_only=m.read_only) for m in mounts_of(container, gang.store)],
        options={**limits(container, node, cores), **linux(container)},
        store=gang.store,
    )


def limits(container: Mapping[str, Any], node: NodePlan, cores: float) -> dict[str, Any]:
    """Cores, memory and GPUs of a node, as Docker's options.

    ``/dev/shm`` has half of the memory, as on the engine aws-batch: Docker's 64 MiB are too few for NCCL between the ranks of a node.
    """
    placement = node.placement
    options: dict[str, Any] = {
        "nano_cpus": int(min(placement.cpus, cores) * 1e9),
        "mem_limit": f"{placement.memory}m",
    }
    if placement.gpus:
        options["device_requests"] = [DeviceRequest(device_ids=list(placement.gpus), capabilities=[["gpu"]])]
    parameters = container.get("linuxParameters") or {}
    options["shm_size"] = f"{parameters.get('sharedMemorySize') or max(64, placement.memory // 2)}m"
    if (swap := parameters.get("maxSwap")) is not None:  # as on AWS, swappiness counts only beside it
        options["memswap_limit"] = f"{placement.memory + swap}m"
        options["mem_swappiness"] = parameters.get("swappiness", 60)
    ulimits = container.get("ulimits") or []
    options["ulimits"] = [Ulimit(name=u["name"], soft=u["softLimit"], hard=u["hardLimit"]) for u in ulimits]
    return options


def linux(container: Mapping[str, Any]) -> dict[str, Any]:
    """The other members of ``containerProperties`` as options of Docker."""
    parameters = container.get("linuxParameters") or {}
    tmpfs = {
        entry["containerPath"]: ",".join([f"size={entry['size']}m", *(entry.get("mountOptions") or [])])
        for entry in parameters.get("tmpfs") or []
    }
    options = {
        "tmpfs": tmpfs,
        "devices": [_device(device) for device in parameters.get("devices") or []],
        "user": container.get("user"),
        "privileged": bool(container.get("privileged")),
        "read_only": bool(container.get("readonlyRootFilesystem")),
    }
    return {"init": bool(parameters.get("initProcessEnabled")), **{k: v for k, v in options.items() if v}}


def _device(device: Mapping[str, Any]) -> str:
    permissions = device.get("permissions") or list(_PERMISSIONS)
    letters = "".join(letter for name, letter in _PERMISSIONS.items() if name in permissions)
    return f"{device['hostPath']}:{device.get('containerPath') or device['hostPath']}:{letters}"
