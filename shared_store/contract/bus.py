"""The bus's protocol, shared by both ends: the keys, the credential that authenticates a message's sender, and the messages about logs.

A node's presence, progress and commands lie below ``muster/<job>/<attempt>/<node>``. Every node may connect to the router, so a
key proves nothing: each attempt has a secret of its own, and each message carries a proof made with it.
"""

from __future__ import annotations

import hashlib
import hmac
import json
from dataclasses import dataclass

LARGEST_MESSAGE = 4 * 2**20
"""Bytes; the router refuses larger messages."""
LONGEST_ANSWER = 500_000
"""Characters of the answer to a command; longer answers are truncated."""
LARGEST_PROGRESS = 65536
"""Bytes of JSON; the controller drops a larger report."""

LARGEST_PUSH = 256 << 10
"""Bytes of a node's log in one message; more is left to those who read the file."""
LOG_LEASE = 40.0
"""Seconds for which a node pushes its log after the command ``log``, which goes to all nodes of an attempt at once and has no answer.

It publishes what it appends below ``log``, and states once a second, with its progress, where the file ends (``LOG_END``).
"""
LOG_END, LOG_IS_WHOLE = "logEnd", "logIsWhole"
"""Members of a progress message: the end of the log [bytes], and whether the node has ended, so that nothing follows."""

LEASE_MILLISECONDS = 2000
"""After how long without a sign the router counts a session as gone (the session's setting counts, not the router's). The controller's own
session has the same: a cut network must take it away together with the nodes."""

Node = tuple[str, int, int]
"""Job, attempt and index of a node."""


@dataclass(frozen=True)
class Credential:
    """Authenticates an attempt's nodes; its text is ``MUSTER_BUS_TOKEN``."""

    password: str
    """Secret of the router, the same for all nodes; it only lets them connect."""
    secret: str
    """Secret of the attempt, known only to its nodes and the controller."""

    @classmethod
    def derive(cls, master: str, job: str, attempt: int) -> Credential:
        """The credential of an attempt, from the controller's master key; nothing has to be stored."""
        password, secret = _mac(master, "router"), _mac(master, "attempt", job, str(attempt))
        return cls(password, secret)

    @classmethod
    def parse(cls, token: str) -> Credential:
        """The credential in a ``MUSTER_BUS_TOKEN``; for a malformed text, one that no router accepts."""
        password, _, secret = token.partition(".")
        return cls(password, secret)

    def __str__(self) -> str:
        return f"{self.password}.{self.secret}"

    def __repr__(self) -> str:
        return "Credential(…)"

    def prove(self, *parts: str) -> str:
        """The proof that ``parts`` come from a holder of the secret."""
        return _mac(self.secret, *parts)

    def proves(self, proof: object, *parts: str) -> bool:
        """Whether ``proof`` is :meth:`prove` of ``parts``."""
        return isinstance(proof, str) and hmac.compare_digest(proof.encode(), self.prove(*parts).encode())


def prefix(job: str, attempt: int, node: int) -> str:
    """Common prefix of a node's keys."""
    return f"muster/{job}/{attempt}/{node}"


def presence_key(credential: Credential, job: str, attempt: int, node: int) -> str:
    """The node's liveliness token. It carries no content, so its proof is part of the key, which only the controller can see."""
    key = f"{prefix(job, attempt, node)}/alive"
    return f"{key}/{credential.prove('presence', key)}"


def log_command(job: str, attempt: int) -> str:
    """The key of the command ``log`` to all nodes of an attempt."""
    return f"muster/{job}/{attempt}/*/command/log"


def push_proof(credential: Credential, key: str, position: int, data: bytes) -> str:
    """The proof of a part of a log, which begins at ``position`` [bytes]."""
    return credential.prove("log", key, str(position), hashlib.sha256(data).hexdigest())


def node_of(key: str) -> Node | None:
    """The node of a key; None if it is not a node's key."""
    parts = key.split("/")
    try:
        return parts[1], int(parts[2]), int(parts[3])
    except (IndexError, ValueError):
        return None


def _mac(secret: str, *parts: str) -> str:
    return hmac.new(secret.encode(), json.dumps(parts).encode(), hashlib.sha256).hexdigest()
