"""The node's end of the bus: its presence, its progress, its log while a user follows it, and the commands that reach it.

Only the supervisor speaks on the bus; training knows nothing of it, so a bus that is off, slow or restarted can't be noticed
there. Nothing in here waits: a router that can't be reached is tried again, and what is put meanwhile is lost, which is allowed.
"""

from __future__ import annotations

import contextlib
import json
import os
import queue
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from shared_store.contract.bus import (
    LARGEST_PROGRESS,
    LARGEST_PUSH,
    LEASE_MILLISECONDS,
    LOG_END,
    LOG_IS_WHOLE,
    LOG_LEASE,
    LONGEST_ANSWER,
    Credential,
    log_command,
    prefix,
    presence_key,
    push_proof,
)
from shared_store.contract.node import NodeContract
from shared_store.volume.files import json_object

if TYPE_CHECKING:
    import zenoh

_RETRY_SECONDS = 2.0
_PROGRESS_SECONDS = 1.0
_PUSHED_A_SECOND = 2 << 20
"""Bytes of its log that a node pushes in one second; of more, those who follow it read the file."""


class BusCommand:
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
        self.commands: queue.SimpleQueue[BusCommand] = queue.SimpleQueue()
        self._node = contract.job, contract.attempt, contract.node_index
        self._prefix = prefix(*self._node)
        self._credential = Credential.parse(contract.bus_token or "")
        self._received: set[str] = set()
        """Ids of the commands that came: a repeated one is not carried out again."""
        self._session: zenoh.Session | None = None
        self._declared: list[Any] = []
        self._next_try = self._next_progress = 0.0
        self._followed_until = 0.0
        self._pushed = 0
        """Bytes since the last progress."""

    @property
    def is_followed(self) -> bool:
        """Whether a user follows the node's log."""
        return self._session is not None and time.monotonic() < self._followed_until

    def push_log(self, position: int, data: bytes) -> None:
        """Publish a part of the node's log, which begins at ``position`` [bytes]; too much at once is left to those who read the file."""
        self._pushed += len(data)
        if self._session is None or len(data) > LARGEST_PUSH or self._pushed > _PUSHED_A_SECOND:
            return
        key = f"{self._prefix}/log"
        self._put(key, data, f"{push_proof(self._credential, key, position, data)} {position}")

    def end_log(self, progress: dict[str, Any] | None, end: int | None) -> None:
        """Tell those who follow the node's log that it is whole, and where it ends [bytes]."""
        if self.is_followed and end is not None:
            self._put_progress({**(progress or {}), LOG_END: end, LOG_IS_WHOLE: True})

    def tend(self, progress: dict[str, Any] | None, log_end: Callable[[], int | None] = lambda: None) -> None:
        """Open the session where there is none yet, and publish ``progress`` once a second: an empty one, too, is a heartbeat.

        ``log_end``: the end of the node's log [bytes], which its followers get; None where it is unknown.
        """
        now = time.monotonic()
        if self.contract.bus is None:
            return
        if self._session is None and now >= self._next_try:
            self._next_try = now + _RETRY_SECONDS
            self._open()
        if self._session is not None and now >= self._next_progress:
            self._next_progress = now + _PROGRESS_SECONDS
            self._pushed = 0
            end = log_end() if self.is_followed else None
            self._put_progress({**(progress or {}), **({} if end is None else {LOG_END: end})})

    def _put_progress(self, progress: dict[str, Any]) -> None:
        key, text = f"{self._prefix}/progress", json.dumps(progress)
        if len(text) <= LARGEST_PROGRESS:
            self._put(key, text, self._credential.prove("progress", key, text))

    def _put(self, key: str, payload: str | bytes, attachment: str) -> None:
        import zenoh

        # DROP: a reader that is slow must cost a message, not our time
        drop = zenoh.CongestionControl.DROP
        if self._session is not None:
            self._session.put(key, payload, attachment=attachment, congestion_control=drop)

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
        known = not isinstance(number, str) or number in self._received
        if known or not self._credential.proves(proof, "command", key, number):
            query.drop()
            return
        if key == log_command(*self._node[:2]):
            self._followed_until = time.monotonic() + LOG_LEASE
            query.drop()
            return
        self._received.add(number)
        self.commands.put(BusCommand(query, self._credential, key, number))
        try:
            os.write(self._wakeup, b"c")
        except OSError:
            pass  # full: it wakes anyway
