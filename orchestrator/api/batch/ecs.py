"""The ECS form of a container: ``ecsProperties``, the newer form of ``containerProperties``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from orchestrator.domain.errors import ClientError

_OF_TASK = {
    **{"executionRoleArn": "executionRoleArn", "taskRoleArn": "jobRoleArn", "volumes": "volumes"},
    **{name: name for name in ("ephemeralStorage", "networkConfiguration", "platformVersion", "runtimePlatform")},
}
"""Members of the task, and what they are called in ``containerProperties``; ``platformVersion`` stands there by itself."""
_UNSUPPORTED_OF_TASK = ("ipcMode", "pidMode", "enableExecuteCommand", "networkMode")
_UNSUPPORTED_OF_CONTAINER = ("dependsOn", "firelensConfiguration", "startTimeout", "stopTimeout")


def from_ecs(properties: Mapping[str, Any], where: str) -> dict[str, Any]:
    """The equivalent ``containerProperties``. Raises ClientError for members without an equivalent."""
    task = _only(properties["taskProperties"], "task", where)
    container = _only(task["containers"], "container", where)
    for section, keys in ((task, _UNSUPPORTED_OF_TASK), (container, _UNSUPPORTED_OF_CONTAINER)):
        for key in keys:
            if section.get(key):
                raise ClientError(f"{where}: {key} is not supported; leave it out")
    if container.get("essential") is False:
        raise ClientError(f"{where}: the only container of a job is essential; leave essential out")
    same = {key: value for key, value in container.items() if key not in ("name", "essential")}
    return {**same, **{ours: task[theirs] for theirs, ours in _OF_TASK.items() if theirs in task}}


def override_from_ecs(override: Mapping[str, Any], defined: str, where: str) -> dict[str, Any]:
    """The ``containerOverrides`` that mean the same as ``ecsPropertiesOverride`` of a container called ``defined``. Raises ClientError."""
    if not override.get("taskProperties"):
        return {}
    containers = _only(override["taskProperties"], "task", where).get("containers")
    if not containers:
        return {}
    changes = dict(_only(containers, "container", where))
    if (name := changes.pop("name", None)) is not None and name != defined:
        raise ClientError(f"{where}: there is no container {name[:100]!r}; the definition's is called {defined!r}")
    return changes


def container_name(properties: Mapping[str, Any]) -> str:
    """The container's name in the definition."""
    return str(properties["taskProperties"][0]["containers"][0].get("name") or "default")


def to_ecs(container: Mapping[str, Any], name: str, task: Mapping[str, Any]) -> dict[str, Any]:
    """``ecsProperties`` of a container detail; ``task``: members of the whole task, such as ``taskArn``."""
    own = {key: value for key, value in container.items() if key not in (*_OF_TASK.values(), *task)}
    of_task = {theirs: container[ours] for theirs, ours in _OF_TASK.items() if ours in container}
    return {"taskProperties": [{"containers": [{**own, "name": name, "essential": True}], **of_task, **task}]}


def _only(entries: Any, what: str, where: str) -> Mapping[str, Any]:
    if len(entries) != 1:
        raise ClientError(f"{where}: {len(entries)} {what}s; a job has one {what} here, with one container")
    only: Mapping[str, Any] = entries[0]
    return only
