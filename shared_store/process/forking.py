"""Ranks that are forked from a process which has imported what they need, instead of being started: the messages between all involved.

The fork server (:mod:`worker.fork_server`) forks for each node a process that becomes its shim, below it one that becomes its supervisor,
and below that its ranks, which wait for their supervisor. So parents, signals, control groups and environments are as without it.
"""

from __future__ import annotations

import json
import socket
from collections.abc import Mapping, Sequence
from typing import Any

RANKS = "MUSTER_FORKED_RANKS"
"""Variable of a supervisor: ``PID:DESCRIPTOR`` of each rank that waits for it, separated by commas."""
_LATE = (
    "MUSTER_",
    "AWS_BATCH_",
    "AWS_EXECUTION_ENV",
    "MASTER_",
    "NODE_RANK",
    "NNODES",
    "CUDA_VISIBLE_DEVICES",
    "WARP_CACHE_PATH",
)
"""How names of variables begin that no library reads while it is imported."""
PADDING = "MUSTER_PADDING"
"""Variable of the fork server whose place in memory its ranks use to show their own variables."""
_MODULES = ("python", "-P", "-m")
_HEAD = 8
"""Bytes of the length that stands before a message."""


def module_of(command: Sequence[str]) -> str | None:
    """The module that a rank's command runs if it can be forked; None for any other program."""
    is_ours = len(command) == 4 and tuple(command[:3]) == _MODULES and command[3].startswith("worker.")
    return command[3] if is_ours else None


def early(environment: Mapping[str, str]) -> dict[str, str]:
    """The variables that libraries may read while they are imported."""
    return {name: value for name, value in environment.items() if not name.startswith(_LATE)}


def send(channel: socket.socket, message: Mapping[str, Any], descriptors: Sequence[int] = ()) -> None:
    """Send a message, and descriptors with it. Raises OSError."""
    data = json.dumps(message).encode()
    socket.send_fds(channel, [len(data).to_bytes(_HEAD, "big")], descriptors)
    channel.sendall(data)


def receive(channel: socket.socket) -> tuple[dict[str, Any], list[int]] | None:
    """The next message and its descriptors; None at the end. Raises OSError."""
    head, descriptors, _, _ = socket.recv_fds(channel, _HEAD, 8)
    while head and len(head) < _HEAD:
        head += channel.recv(_HEAD - len(head))
    data, size = bytearray(), int.from_bytes(head, "big")
    while len(data) < size and (chunk := channel.recv(size - len(data))):
        data += chunk
    return (json.loads(data), list(descriptors)) if head and len(data) == size else None
