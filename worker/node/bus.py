"""The node's end of the bus: its presence, its progress, and the commands that reach it.

Only the supervisor speaks on the bus; training knows nothing of it, so a bus that is off, slow or restarted can't be noticed
there. Nothing in here waits: a router that is away is tried again, and what is put meanwhile is lost, which is allowed.
"""

from __future__ import annotations

import contextlib
import json
import os
import queue
import time
from typing import TYPE_CHECKING, Any

from shared_store.bus import LARGEST_PROGRESS, LEASE_MILLISECONDS, LONGEST_ANSWER, Credential, prefix, presence_key
from shared_store.contract import NodeContract
from shared_store.files import json_object

if TYPE_CHECKING:
    import zenoh

_RETRY_SECONDS = 2.0
_PROGRESS_SECONDS = 1.0


class Command:
    """A command from the controller that waits for its answer: ``checkpoint``, ``stacks`` or ``stop``."""

    def __init__(self, query: Any, credential: Credential, key: str, number: str) -> None:
        self._query, self._credential, self._key, self._number = query, credential, key, number
        self.name = key.rpartition("/")[2]

    def reply(self, text: str) -> None:
        """Answer, once."""
        text = text[:LONGEST_ANSWER]
        proof = self._credential.prove("answer", self._key, self._number, text)
        try:
            self._query.reply(self._key, json.dumps({"text": text, "proof": proof}))
        except Exception:  # the asker or the router is gone: no one waits for the answer any more
            pass
        finally:
            self._query.drop()


class NodeBus:
    """A client session of the controller's router, opened as soon as there is one."""

    def __init__(self, contract: NodeContract, wakeup: int) -> None:
        """``wakeup``: descriptor that is written to when a command arrives."""
        self.contract, self._wakeup = contract, wakeup
        self.commands: queue.SimpleQueue[Command] = queue.SimpleQueue()
        self._node = contract.job, contract.attempt, contract.node_index
        self._prefix = prefix(*self._node)
        self._credential = Credential.parse(contract.bus_token or "")
        self._heard: set[str] = set()
        """Ids of the commands that came: a repeated one is not carried out again."""
        self._session: zenoh.Session | None = None
        self._declared: list[Any] = []
        self._next_try = self._next_progress = 0.0

    def tend(self, progress: dict[str, Any] | None) -> None:
        """Open the session where there is none yet, and publish ``progress`` once a second: an empty one, too, is a sign of life."""
        now = time.monotonic()
        if self.contract.bus is None:
            return
        if self._session is None and now >= self._next_try:
            self._next_try = now + _RETRY_SECONDS
            self._open()
        if self._session is not None and now >= self._next_progress:
            self._next_progress = now + _PROGRESS_SECONDS
            import zenoh

            # DROP: a reader that is slow must cost a message, not our time
            drop = zenoh.CongestionControl.DROP
            key, text = f"{self._prefix}/progress", json.dumps(progress or {})
            if len(text) <= LARGEST_PROGRESS:
                proof = self._credential.prove("progress", key, text)
                self._session.put(key, text, attachment=proof, congestion_control=drop)

    def close(self) -> None:
        """Leave the bus; the token is withdrawn."""
        if self._session is not None:
            import zenoh

            with contextlib.suppress(zenoh.ZError):  # the router does not answer, and Zenoh gave up waiting for it
                self._session.close()
            self._session = None

    def _open(self) -> None:
        try:
            import zenoh
        except ImportError:
            self._next_try = float("inf")  # a node without the package works without the bus
            return
        zenoh.init_log_from_env_or("off")
        config = zenoh.Config()
        settings = {
            "mode": "client",
            "connect/endpoints": [self.contract.bus],
            "scouting/multicast/enabled": False,
            "transport/shared_memory/enabled": False,
            "transport/link/tx/lease": LEASE_MILLISECONDS,
            "transport/auth/usrpwd/user": "muster",
            "transport/auth/usrpwd/password": self._credential.password,
        }
        for key, value in settings.items():
            config.insert_json5(key, json.dumps(value))
        try:
            session = zenoh.open(config)
        except zenoh.ZError:
            return
        # direct callbacks run on the network's thread: they only enqueue, and they don't keep a dying process alive
        handler = zenoh.handlers.Callback(self._receive, indirect=False)
        self._declared = [
            session.declare_queryable(f"{self._prefix}/command/*", handler),
            session.liveliness().declare_token(presence_key(self._credential, *self._node)),
        ]
        self._session = session

    def _receive(self, query: Any) -> None:
        """Take a command that the controller has proved to be its own; drop any other."""
        key = str(query.key_expr)
        try:
            request = json_object(query.payload.to_bytes(), "command")
            number, proof = request["id"], request["proof"]
        except (AttributeError, ValueError, KeyError):  # AttributeError: no payload
            number, proof = "", None
        known = not isinstance(number, str) or number in self._heard
        if known or not self._credential.proves(proof, "command", key, number):
            query.drop()
            return
        self._heard.add(number)
        self.commands.put(Command(query, self._credential, key, number))
        try:
            os.write(self._wakeup, b"c")
        except OSError:
            pass  # full: it wakes anyway
