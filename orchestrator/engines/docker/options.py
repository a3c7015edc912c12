"""A node's placement and ``containerProperties`` as options of Docker."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from docker.types import DeviceRequest, Ulimit

from orchestrator.engines.api import NodePlan

_PERMISSIONS = {"READ": "r", "WRITE": "w", "MKNOD": "m"}
"""Of devices, and their letters in Docker."""


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
    options: dict[str, Any] = {"init": bool(parameters.get("initProcessEnabled"))}
    if tmpfs := parameters.get("tmpfs"):
        options["tmpfs"] = {
            entry["containerPath"]: ",".join([f"size={entry['size']}m", *(entry.get("mountOptions") or [])])
            for entry in tmpfs
        }
    if devices := parameters.get("devices"):
        options["devices"] = [_device(device) for device in devices]
    if user := container.get("user"):
        options["user"] = user
    if container.get("privileged"):
        options["privileged"] = True
    if container.get("readonlyRootFilesystem"):
        options["read_only"] = True
    return options


def _device(device: Mapping[str, Any]) -> str:
    permissions = device.get("permissions") or list(_PERMISSIONS)
    letters = "".join(letter for name, letter in _PERMISSIONS.items() if name in permissions)
    return f"{device['hostPath']}:{device.get('containerPath') or device['hostPath']}:{letters}"
