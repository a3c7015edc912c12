"""The bus's router, inside the controller: which nodes are present, their progress and logs, and commands to them.

Every node may connect; access rules in the router let a node publish below node keys and answer commands, and nothing else: it
can neither send a command nor read a message. A node's message counts only with the proof of its attempt's credential, and
commands carry that proof to the node (:mod:`shared_store.contract.bus`).

The bus is never a truth. Where a node's token vanishes, the controller looks at the engine at once instead of at the next interval; what the
silence proves is a matter of :mod:`orchestrator.control.presence`. A lost message costs nothing. With the bus off everything works from the
store and the engine, slower.
"""

from __future__ import annotations

import contextlib
import hmac
import json
import logging
import os
import secrets
import socket
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

from orchestrator.control.presence import Presence
from orchestrator.domain.errors import Unavailable
from orchestrator.persistence.own_secrets import BUS_KEY, BUS_PORT
from shared_store.contract.bus import (
    LARGEST_MESSAGE,
    LARGEST_PROGRESS,
    LARGEST_PUSH,
    LEASE_MILLISECONDS,
    LOG_END,
    LOG_IS_WHOLE,
    Credential,
    Node,
    log_command,
    node_of,
    prefix,
    presence_key,
    push_proof,
)
from shared_store.volume.files import DamagedFile, json_object, write_atomic

log = logging.getLogger("muster.bus")

_NODES = "muster/*/*/*"
_RULES = (  # flow, messages, keys below those of a node
    ("ingress", ["put"], ["progress", "log"]),
    ("ingress", ["liveliness_token"], ["alive/*"]),
    ("ingress", ["declare_queryable", "reply"], ["command/*"]),
    ("egress", ["query"], ["command/*"]),
)
_ACCESS = {
    "enabled": True,
    "default_permission": "deny",
    "rules": [
        {
            "id": f"nodes-{number}",
            "permission": "allow",
            "flows": [flow],
            "messages": messages,
            "key_exprs": [f"{_NODES}/{key}" for key in keys],
        }
        for number, (flow, messages, keys) in enumerate(_RULES)
    ],
    "subjects": [{"id": "nodes"}],
    "policies": [{"rules": [f"nodes-{number}" for number in range(len(_RULES))], "subjects": ["nodes"]}],
}
"""Access rules for messages between the router and a node. Zenoh reads rules and users once, when the router starts, so that they can't name
attempts; the proofs do that. The controller's own session is inside the router: no rule applies to it."""

_THREADS = "(rx: (worker_threads: 32))"
"""The router's receiving threads, in the syntax of ``ZENOH_RUNTIME``. A node that vanishes silently blocks one of them for 10 s
(eclipse-zenoh/zenoh#2718): with the default of two, a host that dies with many nodes makes the router unresponsive for 5 s a node."""

_UNANSWERED = 5.0
"""Seconds for which a command without an answer is kept."""
_DIGITS = 18
"""Of the greatest position in a log."""

_ITSELF: Node = ("controller", 0, 0)
"""The controller's own session, as a node that no job has."""


class BusError(Exception):
    """A command got no answer; the message says why."""


class Kept(Protocol):
    """Where port and master key of the bus are kept: :class:`orchestrator.persistence.own_secrets.OwnSecrets`, or a dictionary."""

    def get(self, name: str, /) -> str | None: ...

    def __setitem__(self, name: str, text: str, /) -> None: ...


class Bus:
    """A Zenoh router with a password, on loopback and where nodes on other machines (or in containers) see this one.

    Its port and master key stay the same for a database.

    They must: nodes that outlive a controller look for its successor where they found it.
    """

    def __init__(self, home: Path, kept: Kept, addresses: Sequence[str] = (), presence: Presence | None = None) -> None:
        """
        Args:
            home: The home directory, for the file in which Zenoh reads the router's password.
            kept: Has port and master key.
            addresses: Addresses of this machine on which the router listens beside loopback.
            presence: Which nodes are connected.
        """
        self.presence = presence or Presence()
        """Which nodes are connected."""
        self.changed: Callable[[str], None] = lambda _: None
        """Called (on the network's thread) with the job of a node that came or went."""
        self.pushed: Callable[[Node, int, bytes], None] = lambda *_: None
        """Called (on the network's thread) with a part of a node's log and the position at which it begins."""
        self.stated: Callable[[Node, int | None, bool], None] = lambda *_: None
        """Called (on the network's thread) with the end of a node's log (None: it does not push it), and whether nothing follows."""
        self.is_followed: Callable[[str], bool] = lambda _: False
        """Whether anyone follows the logs of this job: pushes of others are dropped unread."""
        self._home, self._kept, self._addresses = home, kept, addresses
        self._lock = threading.Lock()
        self._progress: dict[Node, dict[str, Any]] = {}
        self._session: Any = None
        self._loopback: Any = None
        """A session of the controller's own that reaches the router as nodes do: it tells a router that hears nobody from nodes that are gone."""
        self._declared: list[Any] = []
        self._master = ""
        self.endpoint: str | None = None

    def open(self) -> None:
        """Start the router. Where that fails, the bus is off: a log line says so, and everything else works as usual.

        Raises SealError where the master key can't be opened.
        """
        if os.environ.get("MUSTER_BUS_OFF"):
            return
        try:
            found = self._kept.get(BUS_KEY)
            self._master = found or secrets.token_hex(32)
            if found is None:
                self._kept[BUS_KEY] = self._master
            before = int(self._kept.get(BUS_PORT) or 0)
            for port in (before, _free_port()):
                if port and self._try(port):
                    self.endpoint = f"tcp/127.0.0.1:{port}"
                    if port != before:
                        self._kept[BUS_PORT] = str(port)
                    return
            trouble = "no router could be started"
        except OSError as error:  # the volume is full, say; what runs can be stopped all the same
            trouble = f"{self._home} can't be written ({error.strerror})"
            self.close()
        except Unavailable as error:
            trouble = str(error)
            self.close()
        log.warning("the bus is off: %s; jobs run without commands and live lines", trouble)

    def _try(self, port: int) -> bool:
        import zenoh

        zenoh.init_log_from_env_or("off")
        users = self._home / "bus-users"
        line = f"muster:{self._credential('', 0).password}\n".encode()
        if not users.exists() or users.read_bytes() != line:
            write_atomic(users, line, mode=0o600)
        settings = {
            "mode": "router",
            "listen/endpoints": [f"tcp/{address}:{port}" for address in ("127.0.0.1", *self._addresses)],
            "scouting/multicast/enabled": False,
            "scouting/gossip/enabled": False,
            "scouting/delay": 0,  # else it looks for other routers for half a second; there are none
            "transport/shared_memory/enabled": False,
            "transport/link/rx/max_message_size": LARGEST_MESSAGE,
            "transport/auth/usrpwd/dictionary_file": str(users),
            "access_control": _ACCESS,
        }
        direct = zenoh.handlers.Callback  # they run on the network's thread, and only note what came
        try:
            with _receiving_threads():
                self._session = _opened(settings)
            self._declared = [
                self._session.liveliness().declare_subscriber(
                    f"{_NODES}/alive/*", direct(self._presence, indirect=False), history=True
                ),
                self._session.declare_subscriber(f"{_NODES}/progress", direct(self._note, indirect=False)),
                self._session.declare_subscriber(f"{_NODES}/log", direct(self._take_log, indirect=False)),
            ]
            self._hear_itself(port)
        except zenoh.ZError as error:
            log.info("no router on port %d: %s", port, error)
            self.close()
            return False
        return True

    def _hear_itself(self, port: int) -> None:
        credential = self._credential(*_ITSELF[:2])
        settings = {
            "mode": "client",
            "connect/endpoints": [f"tcp/127.0.0.1:{port}"],
            "scouting/multicast/enabled": False,
            "transport/link/tx/lease": LEASE_MILLISECONDS,
            "transport/auth/usrpwd/user": "muster",
            "transport/auth/usrpwd/password": credential.password,
        }
        self._loopback = _opened(settings)
        self._declared.append(self._loopback.liveliness().declare_token(presence_key(credential, *_ITSELF)))

    def close(self) -> None:
        """Stop the router; nodes look for the next one."""
        for session in (self._loopback, self._session):
            if session is not None:
                import zenoh

                with contextlib.suppress(zenoh.ZError):  # a node does not answer, and Zenoh gave up waiting for it
                    session.close()
        self._loopback = self._session = None

    def expect(self, job: str, attempt: int, nodes: int, met: Iterable[int] = ()) -> None:
        """Listen to the attempt's nodes from now on, until :meth:`forget`; ``met``: those that an earlier controller met."""
        self.presence.expect(job, attempt, nodes, met)

    def token(self, job: str, attempt: int) -> str | None:
        """``MUSTER_BUS_TOKEN`` of the attempt's nodes; None with the bus off."""
        return str(self._credential(job, attempt)) if self.endpoint else None

    def progress(self, job: str, attempt: int, node: int) -> dict[str, Any] | None:
        """The newest progress that a node reported."""
        with self._lock:
            return self._progress.get((job, attempt, node))

    def forget(self, job: str, attempt: int) -> None:
        """The attempt is closed."""
        self.presence.forget(job, attempt)
        with self._lock:
            for node in [node for node in self._progress if node[:2] == (job, attempt)]:
                del self._progress[node]

    def command(self, job: str, attempt: int, node: int, name: str, seconds: float) -> str:
        """Send a command to a node's supervisor and wait for its answer. Raises BusError."""
        if self._session is None:
            raise BusError("the bus is off; start the controller again to send commands")
        import zenoh

        key = f"{prefix(job, attempt, node)}/command/{name}"
        credential, number, request = self._request(job, attempt, key)
        # all that declare this key are asked, and all answers read: one that another job forged must not hide the node's
        replies = self._session.get(
            key,
            payload=request,
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=seconds,
        )
        for reply in replies:
            answer = _message(reply.ok.payload.to_bytes()) if reply.ok is not None else {}
            text = answer.get("text")
            if isinstance(text, str) and credential.proves(answer.get("proof"), "answer", key, number, text):
                return text
        raise BusError(f"node {node} did not answer within {seconds:g} s; is it still starting, frozen or cut off?")

    def ask_for_logs(self, job: str, attempt: int) -> None:
        """Have all nodes of an attempt push their logs for a while; those who know no pushes answer, and nobody listens."""
        if self._session is None:
            return
        import zenoh

        key = log_command(job, attempt)
        _, _, request = self._request(job, attempt, key)
        ignore: Any = zenoh.handlers.Callback(lambda _: None, indirect=False)
        with contextlib.suppress(zenoh.ZError):  # the next time
            self._session.get(key, ignore, payload=request, target=zenoh.QueryTarget.ALL, timeout=_UNANSWERED)

    def _request(self, job: str, attempt: int, key: str) -> tuple[Credential, str, str]:
        """The attempt's credential, a new number, and the payload of the command with this key and number."""
        credential, number = self._credential(job, attempt), secrets.token_hex(16)
        return credential, number, json.dumps({"id": number, "proof": credential.prove("command", key, number)})

    def _credential(self, job: str, attempt: int) -> Credential:
        return Credential.derive(self._master, job, attempt)

    def _presence(self, sample: Any) -> None:
        key, node = _address(sample)
        if node is None or not (node == _ITSELF or self.presence.expects(node)):
            return
        if not hmac.compare_digest(key.encode(), presence_key(self._credential(*node[:2]), *node).encode()):
            return
        is_present = str(sample.kind).endswith("PUT")
        if node == _ITSELF:
            self.presence.hear_itself(is_present)
            return
        (self.presence.came if is_present else self.presence.left)(node)
        self.changed(node[0])

    def _note(self, sample: Any) -> None:
        key, node = _address(sample)
        if node is None or sample.attachment is None or not self.presence.expects(node):
            return
        payload, proof = sample.payload.to_bytes(), sample.attachment.to_bytes()
        text = payload[: LARGEST_PROGRESS + 1].decode(errors="replace")
        if len(payload) > LARGEST_PROGRESS or not self._credential(*node[:2]).proves(
            proof.decode(errors="replace"), "progress", key, text
        ):
            return
        self.presence.sent(node)
        progress = _message(payload)
        end, is_whole = progress.pop(LOG_END, None), progress.pop(LOG_IS_WHOLE, False)
        if self.is_followed(node[0]):
            self.stated(node, end if type(end) is int and end >= 0 else None, is_whole is True)
        with self._lock:
            if progress and self.presence.expects(node):
                self._progress[node] = progress

    def _take_log(self, sample: Any) -> None:
        key, node = _address(sample)
        if (
            node is None
            or sample.attachment is None
            or not self.is_followed(node[0])
            or not self.presence.expects(node)
        ):
            return
        data, (proof, _, text) = sample.payload.to_bytes(), sample.attachment.to_bytes().partition(b" ")
        if not 0 < len(data) <= LARGEST_PUSH or len(text) > _DIGITS or not text.isdigit():
            return
        position = int(text)
        expected = push_proof(self._credential(*node[:2]), key, position, data)
        if hmac.compare_digest(expected.encode(), proof):
            self.pushed(node, position, data)


def _opened(settings: Mapping[str, Any]) -> Any:
    """A Zenoh session with these settings."""
    import zenoh

    config = zenoh.Config()
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)


@contextlib.contextmanager
def _receiving_threads() -> Iterator[None]:
    """Zenoh reads the variable when the process opens its first session. Nothing that this process starts inherits it."""
    if "ZENOH_RUNTIME" in os.environ:  # an operator knows better
        yield
        return
    os.environ["ZENOH_RUNTIME"] = _THREADS
    try:
        yield
    finally:
        del os.environ["ZENOH_RUNTIME"]


def _address(sample: Any) -> tuple[str, Node | None]:
    """The key of a message, and the node that it names; None where it names none."""
    key = str(sample.key_expr)
    return key, node_of(key)


def _message(payload: bytes) -> dict[str, Any]:
    """The JSON object in a message; empty where there is none."""
    try:
        return json_object(payload, "message")
    except DamagedFile:
        return {}


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
