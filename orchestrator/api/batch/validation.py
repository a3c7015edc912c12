"""Validation of definitions and submissions by the rules that AWS's service model can't say; each is a ClientException on AWS too."""

from __future__ import annotations

import copy
import re
from collections.abc import Mapping
from typing import Any

from orchestrator.api.batch.ecs import container_name, from_ecs, override_from_ecs
from orchestrator.api.batch.members import check_consumables, check_members
from orchestrator.api.batch.value_checks import check_range
from orchestrator.api.http.limits import LARGEST_COMMANDS
from orchestrator.domain.errors import ClientError
from orchestrator.domain.gang import MOST_NODES, target_nodes
from orchestrator.domain.gang_checks import CheckedGang, checked_gang
from shared_store.contract.error_text import shown

_REFERENCE = re.compile(r"Ref::([A-Za-z0-9_-]+)")
_MOST_NODES, _MOST_RANGES, _MOST_CONDITIONS = 1000, 5, 5
_SHORTEST_TIMEOUT = 60
NO_KUBERNETES = "is not supported: no engine is a Kubernetes cluster;"


def check_tries(request: Mapping[str, Any]) -> None:
    """``retryStrategy`` and ``timeout`` of a definition or a submission."""
    retry, timeout = request.get("retryStrategy") or {}, request.get("timeout") or {}
    attempts, conditions = retry.get("attempts"), retry.get("evaluateOnExit") or []
    check_range("retryStrategy attempts", attempts, 1, 10)
    if conditions and attempts is None:
        raise ClientError("retryStrategy evaluateOnExit needs attempts too")
    if len(conditions) > _MOST_CONDITIONS:
        raise ClientError(f"retryStrategy evaluateOnExit has {len(conditions)} entries; at most {_MOST_CONDITIONS}")
    for condition in conditions:
        _check_condition(condition)
    seconds = timeout.get("attemptDurationSeconds")
    if seconds is not None and not _SHORTEST_TIMEOUT <= seconds < 2**31:
        raise ClientError(f"timeout attemptDurationSeconds is {seconds}; it must be at least {_SHORTEST_TIMEOUT}")


def _check_condition(condition: Mapping[str, str]) -> None:
    if condition["action"].upper() not in ("RETRY", "EXIT"):
        raise ClientError(f"retryStrategy evaluateOnExit action is {condition['action'][:50]!r}; it is RETRY or EXIT")
    present = {key: condition[key] for key in ("onExitCode", "onReason", "onStatusReason") if condition.get(key)}
    if not present:
        raise ClientError("retryStrategy evaluateOnExit: an entry needs onExitCode, onReason or onStatusReason")
    for key, pattern in present.items():
        if len(pattern) > 512 or "*" in pattern[:-1]:
            raise ClientError(f"{key} {pattern[:50]!r}: at most 512 characters, with a * at the end only")
    if not re.fullmatch(r"[0-9]*\*?", present.get("onExitCode", "*")):
        raise ClientError(f"onExitCode {present['onExitCode'][:50]!r}: digits, with a * at the end at most")


def check_nodes(properties: Mapping[str, Any], kind: str) -> CheckedGang:
    """Check the nodes of a definition of type ``kind``, or of a job of it once its overrides are applied. Raises ClientError.

    ``properties``: as :func:`node_properties` gives them. Returns the gang that they ask for.
    """
    count, main, ranges = properties["numNodes"], properties["mainNode"], properties["nodeRangeProperties"]
    if not 1 <= count <= MOST_NODES:
        raise _too_many(count)
    if not 0 <= main < count:
        raise ClientError(f"mainNode is {main}; it must be less than numNodes ({count})")
    if not 1 <= len(ranges) <= _MOST_RANGES:
        raise ClientError(f"{len(ranges)} node ranges; a multi-node parallel job has 1 to {_MOST_RANGES}")
    for entry in ranges:
        target = entry["targetNodes"]
        where = _where(entry, kind)
        check_container(entry["container"], where)
        _check_target(target, count)
    gang = checked_gang(properties)
    if count > _MOST_NODES and not gang.options.is_native:
        raise _too_many(count)
    return gang


def _too_many(count: int) -> ClientError:
    return ClientError(f"numNodes is {count}; a multi-node parallel job has 1 to {_MOST_NODES} nodes")


def _check_target(target: str, count: int) -> None:
    try:
        nodes = target_nodes(target, count)
    except ValueError as error:
        raise ClientError(str(error)) from None
    # a range with an open end may be empty in a job that a submission has made smaller
    if nodes[-1] >= count if nodes else not target.endswith(":"):
        raise ClientError(f"targetNodes {target[:20]}: the nodes are 0 to {count - 1}")


def check_container(container: Mapping[str, Any], where: str) -> None:
    """``containerProperties``: image, environment, resources, volumes, and nothing that would have no effect."""
    if not container.get("image"):
        raise ClientError(f"Error executing request, Exception : {where}: Container image is not provided.")
    check_members(container, where)
    if not all(pair.get("name") for pair in container.get("environment") or []):
        raise ClientError(f"{where}: an entry of environment has no name")
    if any("\0" in part for part in container.get("command") or []):
        raise ClientError(f"{where}: a zero byte in the command")
    resources = container.get("resourceRequirements") or []
    kinds = [entry["type"] for entry in resources]
    if len(set(kinds)) != len(kinds):
        raise ClientError(f"{where}: resourceRequirements names {max(kinds, key=kinds.count)} twice")
    for entry in resources:
        _check_resource(entry, where)
    for kind, older, name in (("VCPU", "vcpus", "vCPU"), ("MEMORY", "memory", "Memory")):
        if kind not in kinds and container.get(older) is None:  # the first words are AWS's own
            raise ClientError(
                f"Error executing request, Exception : {name} is not provided. Give {where} a resourceRequirements entry "
                f"of type {kind}"
            )
    for key, least, most in (("vcpus", 1, 10**7), ("memory", 4, 10**12)):  # the most that resourceRequirements can say
        if container.get(key) is not None and not least <= container[key] < most:
            raise ClientError(f"{where}: {key} is {str(container[key])[:30]}; it must be {least} to {most - 1}")
    volumes = {volume.get("name") for volume in container.get("volumes") or []}
    for mount in container.get("mountPoints") or []:
        if mount.get("sourceVolume") not in volumes:
            raise ClientError(
                f"{where}: mountPoints names volume {shown(mount.get('sourceVolume'))}, which volumes does not have"
            )


def _check_resource(entry: Mapping[str, str], where: str) -> None:
    kind, value = entry["type"], entry["value"]
    if kind not in ("VCPU", "MEMORY", "GPU"):
        raise ClientError(f"{where}: resourceRequirements type {kind[:50]!r}; it is VCPU, MEMORY or GPU")
    pattern = r"[0-9]{1,7}(\.[0-9]{1,6})?" if kind == "VCPU" else r"[0-9]{1,12}"
    if not re.fullmatch(pattern, value) or float(value) < {"VCPU": 1e-6, "MEMORY": 4, "GPU": 0}[kind]:
        least = {"VCPU": "a positive number", "MEMORY": "a whole number of MiB, at least 4", "GPU": "a whole number"}[
            kind
        ]
        raise ClientError(f"{where}: resourceRequirements {kind} is {value[:50]!r}; it must be {least}")


def node_properties(document: Mapping[str, Any]) -> dict[str, Any]:
    """A definition's ``nodeProperties``: a single-node job is a gang of one node here.

    Every range has a ``container``, and where it came as ``ecsProperties`` also ``ecs``, the container's name. Raises ClientError.
    """
    check_consumables(document, "the job definition")
    if document["type"] == "multinode":
        nodes = document["nodeProperties"]
        return {
            **nodes,
            "nodeRangeProperties": [
                _in_container(entry, _where(entry, "multinode")) for entry in nodes["nodeRangeProperties"]
            ],
        }
    entry = {"targetNodes": "0:0", "container": document.get("containerProperties")}
    entry["ecsProperties"] = document.get("ecsProperties")
    return {"numNodes": 1, "mainNode": 0, "nodeRangeProperties": [_in_container(entry, _where(entry, "container"))]}


def _where(entry: Mapping[str, Any], kind: str) -> str:
    """The name of a node range in a refusal; a definition of type container has none."""
    return f"node range {entry['targetNodes'][:20]}" if kind == "multinode" else "the container"


def _in_container(entry: Mapping[str, Any], where: str) -> dict[str, Any]:
    present = [key for key in ("container", "ecsProperties", "eksProperties") if entry.get(key)]
    if "eksProperties" in present:
        raise ClientError(f"{where}: eksProperties {NO_KUBERNETES} use container or ecsProperties")
    if present not in (["container"], ["ecsProperties"]):
        raise ClientError(f"{where}: give container or ecsProperties, and only one of them")
    check_consumables(entry, where)
    rest = {key: value for key, value in entry.items() if key not in ("container", "ecsProperties")}
    if present == ["container"]:
        return {**rest, "container": dict(entry["container"])}
    ecs = entry["ecsProperties"]
    return {**rest, "container": from_ecs(ecs, where), "ecs": container_name(ecs)}


def substitute(properties: Mapping[str, Any], parameters: Mapping[str, str]) -> dict[str, Any]:
    """Replace ``Ref::name`` in every command by its parameter.

    Raises ClientError for a parameter that is not given, and as soon as all commands together exceed LARGEST_COMMANDS: a
    parameter may be referred to thousands of times, so a small request could ask for a text that fills the memory.
    """
    sizes = {name: len(value.encode()) for name, value in parameters.items()}
    total = 0

    def add(size: int) -> None:
        nonlocal total
        total += size
        if total > LARGEST_COMMANDS:
            raise ClientError(
                f"the commands exceed {LARGEST_COMMANDS} bytes with their parameters substituted; shorten the parameters, or "
                "refer to them less often"
            )

    def replace(match: re.Match[str]) -> str:
        if match[1] not in parameters:
            raise ClientError(f"Unable to substitute value. No parameter found for reference {match[1]}")
        add(sizes[match[1]] - len(match[0]))
        return parameters[match[1]]

    result = copy.deepcopy(dict(properties))
    for entry in result["nodeRangeProperties"]:
        command = entry["container"].get("command") or []
        for part in command:
            add(len(part.encode()))
        entry["container"]["command"] = [_REFERENCE.sub(replace, part) for part in command]
    return result


def override_container(container: dict[str, Any], changes: Mapping[str, Any]) -> None:
    """``containerOverrides`` on a container: environment merges by name, the command replaces, resources replace by type."""
    if changes.get("command"):
        container["command"] = list(changes["command"])
    if changes.get("instanceType"):
        container["instanceType"] = changes["instanceType"]
    for key, name in (("environment", "name"), ("resourceRequirements", "type")):
        merged = {pair.get(name): pair for pair in [*(container.get(key) or []), *(changes.get(key) or [])]}
        container[key] = list(merged.values())
    for key, kind in (("vcpus", "VCPU"), ("memory", "MEMORY")):  # the deprecated fields replace like the new ones
        if changes.get(key) is not None:
            kept = [each for each in container["resourceRequirements"] if each["type"] != kind]
            container["resourceRequirements"] = [*kept, {"type": kind, "value": str(changes[key])}]


def override_nodes(properties: Mapping[str, Any], overrides: Mapping[str, Any]) -> dict[str, Any]:
    """``nodeOverrides`` on ``nodeProperties``. Raises ClientError for a range or a size that the definition does not allow."""
    result = copy.deepcopy(dict(properties))
    if (count := overrides.get("numNodes")) is not None:
        open_ends = [
            entry["targetNodes"] for entry in result["nodeRangeProperties"] if entry["targetNodes"].endswith(":")
        ]
        if not open_ends:
            raise ClientError(
                "numNodes can be overridden only where a node range of the definition has an open end, such as 0:"
            )
        if not any(int(target[:-1] or 0) < count for target in open_ends):
            raise ClientError(f"numNodes {count}: the open node range {open_ends[0]} begins behind the last node")
        result["numNodes"] = count
    ranges = {entry["targetNodes"]: entry for entry in result["nodeRangeProperties"]}
    for override in overrides.get("nodePropertyOverrides") or []:
        if override["targetNodes"] not in ranges:
            raise ClientError(
                "NodeOverride targets should match job definition. "
                f"Non matching targets - {override['targetNodes'][:50]}"
            )
        override_range(ranges[override["targetNodes"]], override, "multinode")
        if override.get("instanceTypes"):
            ranges[override["targetNodes"]]["instanceTypes"] = list(override["instanceTypes"])
    return result


def override_range(entry: dict[str, Any], changes: Mapping[str, Any], kind: str) -> None:
    """``containerOverrides`` or ``ecsPropertiesOverride`` on a node range, whichever the definition has. Raises ClientError."""
    where = _where(entry, kind)
    check_consumables(changes, where)
    right, wrong = ("ecsPropertiesOverride", "containerOverrides")
    if "ecs" not in entry:
        right, wrong = wrong, right
    if changes.get("eksPropertiesOverride"):
        raise ClientError(f"{where}: eksPropertiesOverride {NO_KUBERNETES} use {right}")
    if changes.get(wrong):
        raise ClientError(f"{where}: {wrong} does not fit the job definition; use {right}")
    override = changes.get(right) or {}
    if "ecs" in entry:
        override = override_from_ecs(override, entry["ecs"], where)
    override_container(entry["container"], override)
