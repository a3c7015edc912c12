"""Fargate: what AWS refuses there is refused here; the rest is kept and shown, and such a job runs on its queue's engine like all others."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from orchestrator.api.batch.value_checks import check_choice, check_range
from orchestrator.domain.errors import ClientError
from orchestrator.domain.gang import FARGATE_MEMBERS

FARGATE = "FARGATE"
_ONLY_FARGATE = FARGATE_MEMBERS[:3]
"""Those that a job on EC2 must not have (AWS Batch API reference, ContainerProperties)."""
_ONLY_EC2 = ("privileged", "ulimits", "instanceType", "vcpus", "memory")
_ONLY_EC2_LINUX = ("devices", "sharedMemorySize", "tmpfs", "maxSwap", "swappiness")
_ONLY_EC2_RESOURCES = (
    *("allocationStrategy", "minvCpus", "desiredvCpus", "instanceTypes", "imageId", "ec2KeyPair", "instanceRole"),
    *("tags", "placementGroup", "bidPercentage", "spotIamFleetRole", "launchTemplate", "ec2Configuration"),
    "scalingPolicy",
)
"""Members of ``computeResources`` that a Fargate compute environment must not have (the same, ComputeResource)."""
_GIB = 1024
_MEMORY: Mapping[float, Sequence[int]] = {
    0.25: (512, 1 * _GIB, 2 * _GIB),
    0.5: range(1 * _GIB, 4 * _GIB + 1, _GIB),
    1: range(2 * _GIB, 8 * _GIB + 1, _GIB),
    2: range(4 * _GIB, 16 * _GIB + 1, _GIB),
    4: range(8 * _GIB, 30 * _GIB + 1, _GIB),
    8: range(16 * _GIB, 60 * _GIB + 1, 4 * _GIB),
    16: range(32 * _GIB, 120 * _GIB + 1, 8 * _GIB),
    32: (60 * _GIB, 120 * _GIB, 244 * _GIB),
}
"""MiB that go with a number of vCPUs (the same, ResourceRequirement)."""
_TYPES = ("EC2", "SPOT", "FARGATE", "FARGATE_SPOT")
_VALUES = (
    ("networkConfiguration", "assignPublicIp", ("ENABLED", "DISABLED")),
    ("runtimePlatform", "cpuArchitecture", ("X86_64", "ARM64")),
)
"""Members of a container's members, and the values that they can have (the same, NetworkConfiguration and RuntimePlatform)."""


def is_fargate(document: Mapping[str, Any]) -> bool:
    """Whether a job definition asks for Fargate."""
    return FARGATE in (document.get("platformCapabilities") or [])


def check_platform(document: Mapping[str, Any], properties: Mapping[str, Any], where: str) -> None:
    """Check what a definition asks of its platform, or a job of it once its overrides are applied. Raises ClientError.

    Args:
        document: The definition.
        properties: Its node properties, with overrides.
        where: What is refused, in a few words.
    """
    if others := set(document.get("platformCapabilities") or []) - {"EC2", FARGATE}:
        raise ClientError(f"{where}: platformCapabilities {min(others)[:50]} is not supported; use EC2 or FARGATE")
    fargate = is_fargate(document)
    if fargate and document["type"] == "multinode":
        raise ClientError(f"{where}: Fargate runs no multi-node parallel jobs; leave platformCapabilities FARGATE out")
    for entry in properties["nodeRangeProperties"]:
        container = entry["container"]
        _check_values(container, where)
        if fargate:
            _check_on_fargate(container, where)
        elif unsupported := next((key for key in _ONLY_FARGATE if container.get(key)), None):
            raise ClientError(
                f"{where}: {unsupported} is for Fargate; add platformCapabilities FARGATE, or leave it out"
            )


def _check_values(container: Mapping[str, Any], where: str) -> None:
    system = (container.get("runtimePlatform") or {}).get("operatingSystemFamily", "LINUX")
    if system != "LINUX":
        raise ClientError(f"{where}: operatingSystemFamily {system[:50]!r} is not supported: nodes run LINUX")
    for member, key, known in _VALUES:
        if value := (container.get(member) or {}).get(key):
            check_choice(f"{where}: {member} {key}", value, *known)
    size = (container.get("ephemeralStorage") or {}).get("sizeInGiB")
    check_range(f"{where}: ephemeralStorage sizeInGiB", size, 21, 200)


def _check_on_fargate(container: Mapping[str, Any], where: str) -> None:
    linux = container.get("linuxParameters") or {}
    unsupported = [
        *(key for key in _ONLY_EC2 if container.get(key)),
        *(f"linuxParameters {key}" for key in _ONLY_EC2_LINUX if linux.get(key) not in (None, [])),
        *(f"volume {each.get('name')!r} of the host" for each in container.get("volumes") or [] if each.get("host")),
    ]
    if unsupported:
        raise ClientError(
            f"{where}: {unsupported[0]} is not for Fargate; leave it out, or use platformCapabilities EC2"
        )
    needs = {each["type"]: each["value"] for each in container.get("resourceRequirements") or []}
    if "GPU" in needs:
        raise ClientError(f"{where}: Fargate has no GPUs; leave GPU out, or use platformCapabilities EC2")
    cpus, memory = float(needs["VCPU"]), int(needs["MEMORY"])
    if cpus not in _MEMORY:
        known = ", ".join(f"{each:g}" for each in _MEMORY)
        raise ClientError(f"{where}: Fargate has no VCPU {needs['VCPU']}; it is {known}")
    if memory not in _MEMORY[cpus]:
        least, most = min(_MEMORY[cpus]), max(_MEMORY[cpus])
        step = f" in steps of {fits.step}" if isinstance(fits := _MEMORY[cpus], range) else ""
        fit = f"{least} to {most}{step}" if step else ", ".join(map(str, fits))
        raise ClientError(f"{where}: Fargate has no MEMORY {memory} with VCPU {needs['VCPU']}; it is {fit}")


def check_resources(resources: Mapping[str, Any]) -> None:
    """Check the type of ``computeResources``, and what that type can't have. Raises ClientError."""
    kind = str(resources.get("type", "EC2"))
    if kind.upper() not in _TYPES:
        raise ClientError(f"computeResources type {kind[:50]!r} is not supported; use {', '.join(_TYPES)}")
    if not kind.upper().startswith(FARGATE):
        return
    unsupported = next((key for key in _ONLY_EC2_RESOURCES if resources.get(key) not in (None, "", [], {})), None)
    if unsupported is not None:
        raise ClientError(f"computeResources {unsupported} is not for {kind}; leave it out")


def of_environment(document: Mapping[str, Any]) -> bool:
    """Whether a compute environment, by its document, is one of Fargate."""
    return str((document.get("computeResources") or {}).get("type", "EC2")).upper().startswith(FARGATE)


def of_queue(documents: Sequence[Mapping[str, Any]]) -> bool:
    """Whether the compute environments of a queue, by their documents, are of Fargate alone."""
    return bool(documents) and all(map(of_environment, documents))


def check_queue(name: str, documents: Sequence[Mapping[str, Any]], definition: Mapping[str, Any]) -> None:
    """A queue of Fargate alone takes no job of EC2, such as one with several nodes or GPUs, as on AWS. Raises ClientError.

    Args:
        name: The queue's.
        documents: Of its compute environments.
        definition: The job's.
    """
    if of_queue(documents) and not is_fargate(definition):
        # the first sentence is AWS's own: clients match it
        raise ClientError(
            "Job Queue is attached to Compute Environment that can not run Jobs with capability EC2. "
            f"Register the definition with platformCapabilities FARGATE, or use another queue than {name}"
        )


def without_effect(definition: Mapping[str, Any], containers: Iterable[Mapping[str, Any]]) -> list[str]:
    """The members of a Fargate job that no engine heeds, by name."""
    unsupported = {key for container in containers for key in FARGATE_MEMBERS if container.get(key)}
    return sorted(unsupported | ({"platformCapabilities"} if is_fargate(definition) else set()))
