"""The lifeline from each child node to the main node, by which the main node learns how they end.

For engines that leave the main node running when a child dies (AWS Batch). The kernel closes a dead supervisor's connection at
once, and asks a silent host whether it is still there; nobody has to write anything while all is well. Imports no torch.
"""

from __future__ import annotations

import contextlib
import json
import socket
import time
from dataclasses import dataclass
from typing import Any

from shared_store.contract.node import NodeContract
from shared_store.volume.node_outcomes import EX_TEMPFAIL

PORT = 29499
"""Port of the main node, one below torch.distributed's."""
_KEEPALIVE = {socket.TCP_KEEPIDLE: 5, socket.TCP_KEEPINTVL: 5, socket.TCP_KEEPCNT: 3}
"""A host that is gone is noticed after 5 + 5 * 3 seconds."""
_WORDS = {"gang": str, "node": int, "code": int, "reason": str}
"""The bytes that a child sends; others come from a stranger."""
_ARRIVAL = 1800.0
"""Seconds that a child may take to come after the main node: its instance pulls an image of many gigabytes."""


@dataclass(frozen=True)
class Loss:
    """Why the gang can't go on."""

    reason: str
    exit_code: int
    """The child's, or 1 if it was not observed."""


class MainEnd:
    """The main node's end of all lines. Never waits; to be asked often."""

    def __init__(self, contract: NodeContract) -> None:
        """Listen at the node's address. Raises OSError."""
        self._gang = contract.gang
        self._server = socket.create_server((contract.address or contract.master_address, PORT), backlog=256)
        self._server.setblocking(False)
        self._lines: list[_Line] = []
        self._missing = set(range(contract.node_count)) - {contract.node_index}
        self._deadline = time.monotonic() + _ARRIVAL

    def lost(self) -> Loss | None:
        """The first child that was found to have failed since the last call; None while all is well."""
        with contextlib.suppress(OSError):
            while True:
                connection, _ = self._server.accept()
                self._lines.append(_Line(connection))
        found = None
        for line in list(self._lines):
            is_connected = line.read()
            node = line.words.get("node") if line.words.get("gang") == self._gang else None
            self._missing.discard(node)
            if is_connected:
                continue
            self._lines.remove(line)
            code = line.words.get("code")
            if node is None or found is not None or code in (0, EX_TEMPFAIL):
                continue
            if code is None:
                found = Loss(f"node {node} vanished: its supervisor or its host died", 1)
            else:
                found = Loss(f"node {node}: {line.words.get('reason', '')}", code)
        if found is None and self._missing and time.monotonic() > self._deadline:
            found = Loss(f"node {min(self._missing)} has not come within {_ARRIVAL:.0f} s of the main node", 1)
        return found


class _Line:
    """One child's connection and what it said."""

    def __init__(self, connection: socket.socket) -> None:
        self._connection, self._partial = connection, b""
        self.words: dict[str, Any] = {}
        connection.setblocking(False)
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        for option, value in _KEEPALIVE.items():
            connection.setsockopt(socket.IPPROTO_TCP, option, value)

    def read(self) -> bool:
        """Take in what came; False once the line is cut."""
        try:
            while chunk := self._connection.recv(65536):
                *whole, self._partial = (self._partial + chunk).split(b"\n")
                for line in whole:
                    with contextlib.suppress(ValueError, RecursionError):  # a stranger
                        words = json.loads(line)
                        if isinstance(words, dict) and all(type(words[key]) is _WORDS.get(key) for key in words):
                            self.words |= words
        except BlockingIOError:
            return True
        except OSError:
            pass  # reset, or the host does not answer any more
        self._connection.close()
        return False


class ChildEnd:
    """A child node's end of its line."""

    def __init__(self, contract: NodeContract) -> None:
        self._contract = contract
        self._connection: socket.socket | None = None

    def attach(self) -> bool:
        """Reach the main node, which may not listen yet; whether it is reached."""
        if self._connection is None:
            with contextlib.suppress(OSError):
                self._connection = socket.create_connection((self._contract.master_address, PORT), timeout=1.0)
                self._say(gang=self._contract.gang, node=self._contract.node_index)
        return self._connection is not None

    def tell(self, exit_code: int, reason: str) -> None:
        """The last word: how the node ended."""
        self._say(code=exit_code, reason=reason)

    def _say(self, **words: object) -> None:
        if self._connection is not None:
            with contextlib.suppress(OSError):
                self._connection.sendall(json.dumps(words).encode() + b"\n")
