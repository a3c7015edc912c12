"""What the ``aws-batch`` engine has to know of an account: ``$MUSTER_HOME/aws.json``, written by ``muster aws up``."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any, get_args, get_type_hints

from orchestrator.engines.api import EngineError
from orchestrator.engines.aws_batch import OPTIONS


@dataclass(frozen=True)
class AwsConfig:
    """Where jobs go on AWS."""

    region: str
    job_queue: str
    """Name or ARN."""
    image: str
    """What the image ``muster`` of a job means there."""
    log_group: str = "/aws/batch/job"
    file_system: str | None = None
    """EFS file system; without one ``store`` must be on the instances already."""
    access_point: str | None = None
    store: str = "/muster/store"
    """Where a node sees the shared volume."""
    store_is_shared: bool | None = None
    """Whether the controller's own store is that volume; None: where it is mounted from it."""
    job_role: str | None = None
    instance_type: str | None = None
    share: str | None = None
    """Share identifier, where the queue has a fair-share policy."""
    efa: bool = False
    max_vcpus: int = 256
    """What the compute environment may grow to, until AWS has said it."""
    poll: float = 2.0
    """Seconds between two looks at a gang, and at its logs."""
    quiet: float = 6.0
    """Seconds without a line after a node's end, after which its log is whole: AWS's log driver sends every five."""
    endpoint_url: str | None = None
    stack: str | None = None
    profile: str | None = None

    def with_options(self, options: Mapping[str, str]) -> AwsConfig:
        """The same with what tags say."""
        told = {option.name: value for option in OPTIONS if (value := options.get(option.name))}
        changes: dict[str, Any] = {name.replace("-", "_"): value for name, value in told.items()}
        return replace(self, **changes)


_WORDS = {str: "a text", bool: "true or false", int: "a whole number", float: "a number"}
_KINDS = {
    name: get_args(kind) or ((int, float) if kind is float else (kind,))
    for name, kind in get_type_hints(AwsConfig).items()
}
"""The types of a key's values."""


def config_path(home: Path) -> Path:
    return home / "aws.json"


def load_config(home: Path) -> AwsConfig:
    """Read ``aws.json``. Raises EngineError where it is missing or damaged, with what to do."""
    path = config_path(home)
    try:
        told = json.loads(path.read_text())
        if not isinstance(told, dict):
            raise EngineError(f"{path}: expected a mapping; `muster aws up` writes it anew")
        known = {field.name for field in fields(AwsConfig)}
        if unknown := set(told) - known:
            raise EngineError(f"{path}: unknown key {min(unknown)}; valid: {', '.join(sorted(known))}")
        for name, kinds in _KINDS.items():
            if name in told and type(told[name]) not in kinds:
                wanted = _WORDS[float if float in kinds else kinds[0]]
                raise EngineError(f"{path}: {name}: expected {wanted}, found {json.dumps(told[name])}")
        return AwsConfig(**told)
    except FileNotFoundError:
        raise EngineError(
            f"{path} is missing: the aws-batch engine does not know where to send jobs; make the stack with `muster aws up`"
        ) from None
    except (OSError, ValueError, TypeError) as error:
        raise EngineError(f"{path}: {error}; `muster aws up` writes it anew") from None


def save_config(home: Path, config: AwsConfig) -> Path:
    """Write ``aws.json``; returns its path. Raises OSError."""
    home.mkdir(mode=0o700, parents=True, exist_ok=True)
    path = config_path(home)
    told = {name: value for name, value in asdict(config).items() if value is not None}
    path.write_text(json.dumps(told, indent=1) + "\n")
    return path


def is_mounted_from(path: Path, file_system: str | None, mounts: str) -> bool:
    """Whether ``path`` lies on a mount of the EFS file system; without one, on any NFS.

    Args:
        path: A directory, with its links followed.
        file_system: Id, ``fs-…``. Amazon's own mount helper hides it behind a tunnel on 127.0.0.1.
        mounts: What ``/proc/self/mountinfo`` says.
    """
    best, kind, source = "", "", ""
    for line in mounts.splitlines():
        left, _, right = line.partition(" - ")
        point = left.split()[4]
        if f"{path}/".startswith(point.rstrip("/") + "/") and len(point) >= len(best):
            best, (kind, source) = point, right.split()[:2]
    return kind.startswith("nfs") and (file_system is None or source.startswith((file_system, "127.0.0.1:")))
