"""Volumes for nodes that are plain processes: bind mounts that only the node sees (a mount namespace of its own)."""

from __future__ import annotations

import os
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from orchestrator.engines.api import EngineError

_SCRIPT = """
while [ "$1" != -- ]; do
  mkdir -p -- "$1" "$2"
  mount --bind -- "$1" "$2"
  [ "$3" = rw ] || mount -o remount,bind,ro -- "$2"
  shift 3
done
shift
exec "$@"
"""


@dataclass(frozen=True)
class Mount:
    """One volume of a container."""

    source: str
    """Directory on the host."""
    target: str
    """Path on the node."""
    read_only: bool = False


def mounts_of(container: Mapping[str, Any], store: str) -> tuple[Mount, ...]:
    """The mounts of ``containerProperties``. An EFS file system is the store, which is what lies on it on AWS.

    Args:
        container: With ``volumes`` and ``mountPoints``.
        store: Path of the shared volume.
    """
    sources: dict[str, str] = {}
    for volume in container.get("volumes") or []:
        if host := (volume.get("host") or {}).get("sourcePath"):
            sources[volume.get("name")] = host
        elif efs := volume.get("efsVolumeConfiguration"):
            below = Path(efs.get("rootDirectory") or "/").as_posix().lstrip("/")
            sources[volume.get("name")] = str(Path(store) / below)
    found = []
    for point in container.get("mountPoints") or []:
        if (source := sources.get(point.get("sourceVolume"))) and (target := point.get("containerPath")):
            found.append(Mount(source, target, bool(point.get("readOnly"))))
    return tuple(found)


def with_mounts(command: Sequence[str], mounts: Sequence[Mount], engine: str = "local") -> list[str]:
    """``command`` so that it sees the mounts; it keeps its process id.

    Args:
        command: What is to be run.
        mounts: What it sees.
        engine: Name of the engine that will run it, for messages.

    Raises:
        EngineError: This process may not mount, or a path can't be used.
    """
    if not mounts:
        return list(command)
    if os.geteuid() != 0 or not shutil.which("unshare"):
        raise EngineError(
            f"volume {mounts[0].target}: the {engine} engine mounts only as root; start `muster serve` as root, "
            "or take the volumes out of the job definition and use $MUSTER_STORE"
        )
    for mount in mounts:
        paths = Path(mount.source), Path(mount.target)
        if any(not path.is_absolute() or ".." in path.parts for path in paths) or mount.target == "/":
            raise EngineError(f"volume {mount.source} at {mount.target}: two absolute paths without '..' are needed")
    triples = [part for m in mounts for part in (m.source, m.target, "ro" if m.read_only else "rw")]
    namespace = ["unshare", "--mount", "--propagation", "private"]
    return [*namespace, "sh", "-ec", _SCRIPT, "mount", *triples, "--", *command]
