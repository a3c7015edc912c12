"""Members of AWS's model that are not supported here: refused by name, in one line.

Members that are ignored are listed in docs/aws-differences.md; a test checks every member of the model against both.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

from orchestrator.domain.errors import ClientError

_REFUSED = {
    "enableExecuteCommand": "is not supported; leave it out",
    "repositoryCredentials": "is not supported; log the controller's Docker in to the registry: docker login",
}
"""Members of ``containerProperties`` that a definition can't have, with what to do. False and empty values say nothing."""
_LOG_OPTIONS = (
    *("awslogs-group", "awslogs-stream-prefix", "awslogs-region", "awslogs-create-group", "awslogs-datetime-format"),
    *("awslogs-multiline-pattern", "awslogs-endpoint", "mode", "max-buffer-size"),
)
"""Options of the driver ``awslogs``; all but the first two change nothing here."""
_LOG_VALUES: Mapping[str, Sequence[str]] = {
    "mode": ("blocking", "non-blocking"),
    # all that Docker's driver reads as true or false
    "awslogs-create-group": ("true", "false", "1", "0", "t", "f", "T", "F", "True", "False", "TRUE", "FALSE"),
}
"""Values of the options that have a few; the first two are named where another one is refused."""
_STREAM_PREFIX = re.compile(r"[^:*]{1,256}")
_USER = re.compile(r"[a-z0-9_][a-z0-9_-]{0,30}(:[a-z0-9_][a-z0-9_-]{0,30})?")
_VOLUME_KINDS = ("host", "efsVolumeConfiguration", "s3filesVolumeConfiguration")
_GROUP = re.compile(r"(?!aws/)[.\-_/#A-Za-z0-9]{1,512}")


def check_consumables(request: Mapping[str, Any], where: str) -> None:
    """Raises ClientError where the request counts on consumable resources."""
    for key in ("consumableResourceProperties", "consumableResourcePropertiesOverride"):
        if (request.get(key) or {}).get("consumableResourceList"):
            raise ClientError(
                f"{where}: {key} is not supported; a job queue with a compute environment of its own limits what runs at once"
            )


def check_members(container: Mapping[str, Any], where: str) -> None:
    """``containerProperties``: refuse members that would have no effect. Raises ClientError."""
    for key, advice in _REFUSED.items():
        if container.get(key):
            raise ClientError(f"{where}: {key} {advice}")
    for volume in container.get("volumes") or []:
        if volume.get("s3filesVolumeConfiguration"):
            raise ClientError(
                f"{where}: volume {volume.get('name')!r}: s3filesVolumeConfiguration is not supported; use host or "
                "efsVolumeConfiguration"
            )
        if not (volume.get("host") or {}).get("sourcePath") and not volume.get("efsVolumeConfiguration"):
            raise ClientError(
                f"{where}: volume {volume.get('name')!r} names no directory: give host.sourcePath or efsVolumeConfiguration"
            )
    if (user := container.get("user")) and not _USER.fullmatch(user):
        raise ClientError(
            f"{where}: user {user[:60]!r}: a name or number, and after a colon a group, in small letters, digits, _ and -"
        )
    _check_log(container.get("logConfiguration") or {}, where)
    _check_secrets(container, where)


def _check_log(log: Mapping[str, Any], where: str) -> None:
    """Logs are kept in the store and read as CloudWatch Logs, in the group and with the prefix that are named here."""
    if not log:
        return
    if log["logDriver"] != "awslogs":
        raise ClientError(
            f"{where}: logConfiguration logDriver {log['logDriver'][:50]!r} is not supported; use awslogs, or leave it out"
        )
    if log.get("secretOptions"):
        raise ClientError(f"{where}: logConfiguration secretOptions is not supported; leave it out")
    for name, value in (log.get("options") or {}).items():
        if name not in _LOG_OPTIONS:
            raise ClientError(f"{where}: logConfiguration option {name[:100]!r} is not supported; leave it out")
        if value and value not in (known := _LOG_VALUES.get(name, (value,))):
            raise ClientError(f"{where}: logConfiguration {name} is {value[:50]!r}; it is {' or '.join(known[:2])}")
        if name == "awslogs-group":
            check_log_group(f"{where}: logConfiguration awslogs-group", value)
        if name == "awslogs-stream-prefix" and not _STREAM_PREFIX.fullmatch(value):
            raise ClientError(
                f"{where}: logConfiguration awslogs-stream-prefix {value[:200]!r}: 1 to 256 characters without ':' and '*'"
            )


def check_log_group(where: str, name: str) -> None:
    """Raises ClientError for a name that no log group can have on AWS."""
    if not _GROUP.fullmatch(name):
        raise ClientError(
            f"{where} {name[:200]!r}: 1 to 512 letters, digits and the characters . - _ / #, not beginning with aws/"
        )


def _check_secrets(container: Mapping[str, Any], where: str) -> None:
    variables = {pair.get("name") for pair in container.get("environment") or []}
    names: set[str] = set()
    for secret in container.get("secrets") or []:
        name = secret["name"]
        if not name or "=" in name or "\0" in name or name.startswith(("AWS_BATCH", "MUSTER_")):
            raise ClientError(
                f"{where}: secret {name[:100]!r}: the name of a variable, without '=', not AWS_BATCH… and not MUSTER_…"
            )
        if name in names or name in variables:
            raise ClientError(f"{where}: {name[:100]} is given twice among secrets and environment")
        names.add(name)
