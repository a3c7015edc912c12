"""The bus's router, inside the controller: who is there, how far they are, and commands to them.

The bus is never a truth. A token that vanishes makes the controller look at the engine at once, instead of at the next interval;
a message that is lost costs nothing. With the bus off everything works from the store and the engine, slower.
"""

from __future__ import annotations

import json
import logging
import os
import secrets
import socket
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from shared_store.files import read_json, write_json

log = logging.getLogger("muster.bus")

Node = tuple[str, int, int]
"""Job, attempt and index of a node."""


class BusError(Exception):
    """A command got no answer; the message says why."""


class Bus:
    """A Zenoh router with a password, on loopback and where nodes on other machines (or in containers) see this one.

    Its port and password stay the same for a home directory.

    They must: nodes that outlive a controller look for its successor where they found it.
    """

    def __init__(self, home: Path, addresses: Sequence[str] = ()) -> None:
        """``addresses``: of this machine, to listen on beside loopback."""
        self.changed: Callable[[], None] = lambda: None
        """Called (on the network's thread) when a node came or went."""
        self._home, self._addresses = home, addresses
        self._lock = threading.Lock()
        self._gone: dict[Node, float | None] = {}
        """Since when (monotonic [s]) each node that was ever here is gone; None while it is here."""
        self._progress: dict[Node, dict[str, Any]] = {}
        self._opened: float | None = None
        """When (monotonic [s]) this router took its predecessor's place; None where nodes can't know that it is here."""
        self._session: Any = None
        self._declared: list[Any] = []
        self.endpoint: str | None = None
        self.token: str | None = None

    def open(self) -> None:
        """Start the router. Where that fails the bus is off, which is logged, and nothing else is different."""
        if os.environ.get("MUSTER_BUS_OFF"):
            return
        kept = read_json(self._home / "bus.json") or {}
        token = str(kept.get("token") or secrets.token_urlsafe(24))
        for port in (int(kept.get("port") or 0), _free_port()):
            if port and self._try(port, token):
                self.endpoint, self.token = f"tcp/127.0.0.1:{port}", token
                self._opened = time.monotonic() if port == kept.get("port") else None
                write_json(self._home / "bus.json", {"port": port, "token": token})
                (self._home / "bus.json").chmod(0o600)
                return
        log.warning("the bus is off: no router could be started; jobs run, commands to them do not")

    def _try(self, port: int, token: str) -> bool:
        import zenoh

        zenoh.init_log_from_env_or("off")
        users = self._home / "bus-users"
        users.touch(mode=0o600)
        users.write_text(f"muster:{token}\n")
        config = zenoh.Config()
        settings = {
            "mode": "router",
            "listen/endpoints": [f"tcp/{address}:{port}" for address in ("127.0.0.1", *self._addresses)],
            "scouting/multicast/enabled": False,
            "transport/shared_memory/enabled": False,
            "transport/auth/usrpwd/dictionary_file": str(users),
        }
        for key, value in settings.items():
            config.insert_json5(key, json.dumps(value))
        try:
            self._session = zenoh.open(config)
        except zenoh.ZError as error:
            log.info("no router on port %d: %s", port, error)
            return False
        direct = zenoh.handlers.Callback  # they run on the network's thread, and only note what came
        self._declared = [
            self._session.liveliness().declare_subscriber(
                "muster/*/*/*/alive", direct(self._presence, indirect=False), history=True
            ),
            self._session.declare_subscriber("muster/*/*/*/progress", direct(self._note, indirect=False)),
        ]
        return True

    def close(self) -> None:
        """Stop the router; nodes look for the next one."""
        if self._session is not None:
            self._session.close()
            self._session = None

    def met(self, job: str, attempt: int, node: int) -> bool:
        """Whether the node is here, or was."""
        with self._lock:
            return (job, attempt, node) in self._gone

    def silence(self, job: str, attempt: int, node: int, met_before: bool = False) -> float | None:
        """For how many seconds a node that was here is gone; None where it is here, or never was.

        ``met_before``: an earlier router met it. One that does not come back to this one is gone since this one is there.
        """
        with self._lock:
            since = self._gone.get((job, attempt, node), self._opened if met_before else None)
        return None if since is None else time.monotonic() - since

    def progress(self, job: str, attempt: int, node: int) -> dict[str, Any] | None:
        """The newest progress that a node told of."""
        with self._lock:
            return self._progress.get((job, attempt, node))

    def forget(self, job: str, attempt: int) -> None:
        """The attempt is over."""
        with self._lock:
            for table in (self._gone, self._progress):
                for node in [node for node in table if node[:2] == (job, attempt)]:
                    del table[node]

    def command(self, job: str, attempt: int, node: int, name: str, seconds: float) -> str:
        """Send a command to a node's supervisor and wait for its answer. Raises BusError."""
        if self._session is None:
            raise BusError("the bus is off; start the controller again to send commands")
        key = f"muster/{job}/{attempt}/{node}/command/{name}"
        for reply in self._session.get(key, timeout=seconds):
            if reply.ok is not None:
                return str(json.loads(reply.ok.payload.to_string())["text"])
        raise BusError(f"node {node} did not answer within {seconds:g} s; is it still starting, frozen or cut off?")

    def _presence(self, sample: Any) -> None:
        node = _node_of(str(sample.key_expr))
        here = str(sample.kind).endswith("PUT")
        with self._lock:
            self._gone[node] = None if here else time.monotonic()
        self.changed()

    def _note(self, sample: Any) -> None:
        try:
            progress = json.loads(sample.payload.to_string())
        except ValueError:
            return
        with self._lock:
            self._progress[_node_of(str(sample.key_expr))] = progress


def _node_of(key: str) -> Node:
    _, job, attempt, node, _ = key.split("/")
    return job, int(attempt), int(node)


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
