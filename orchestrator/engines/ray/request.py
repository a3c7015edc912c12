"""The request for a gang to the driver of its job."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from shared_store.contract.node import NodeContract


@dataclass(frozen=True)
class NodeRequest:
    """One node."""

    contract: NodeContract
    command: Sequence[str]
    environment: Mapping[str, str]
    prefix: Sequence[str]
    """Goes before the command: what gives it its mounts."""
    cpus: float
    gpus: int
    memory: int
    """MiB."""
    host: str
    pin: str | None
    """Id of the Ray node that it goes to; None for any that has room."""


@dataclass(frozen=True)
class GangRequest:
    """A whole gang: its placement group, and what runs on each bundle."""

    gang: str
    main: int
    directory: str | None
    nodes: Sequence[NodeRequest]

    def told(self) -> dict[str, Any]:
        """As the driver reads it, for JSON."""
        return asdict(self)
