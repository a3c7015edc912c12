"""The ROS 2 graph of a Zenoh session: a node with its tokens, publishers and subscriptions, and who else is there."""

from __future__ import annotations

import contextlib
import json
import re
import threading
import time
from collections.abc import Callable
from typing import Any

import zenoh
import zenoh.ext

from muster_policy.errors import Refused
from muster_policy.messages import Messages
from muster_policy.wire import (
    Endpoint,
    Qos,
    attachment,
    endpoint_token,
    gid_of,
    node_token,
    parse_token,
    read_attachment,
    ros_type,
    topic_key,
)

Received = Callable[[bytes, str, str], None]
"""Called with a message's bytes, its ROS type and its type hash, on Zenoh's own thread."""
Answer = Callable[[bytes], None]
"""Answers a request of a service with the bytes of its response; to be called once, on any thread."""


def open_session(connect: str | None, listen: str | None) -> zenoh.Session:
    """A session as a ROS node's: a peer of a router; or the router itself.

    Args:
        connect: Endpoint of a router, such as ``tcp/localhost:7447``.
        listen: Be a router on this endpoint, so that no ``rmw_zenohd`` is needed; then ``connect`` is a further router, if any.

    Raises:
        Refused: The endpoint is taken, or is none.
    """
    config = zenoh.Config()
    config.insert_json5("mode", json.dumps("router" if listen else "peer"))
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("transport/shared_memory/enabled", "false")
    try:
        config.insert_json5("listen/endpoints", json.dumps([listen or "tcp/localhost:0"]))
        config.insert_json5("connect/endpoints", json.dumps([connect] if connect else []))
        return zenoh.open(config)
    except zenoh.ZError as error:
        where = f"--listen {listen}" if listen else f"--connect {connect}"
        reason = re.sub(r" at /\S*", "", " ".join(str(error).split()))[:160]  # places in Zenoh's own source
        if "Address already in use" in reason:
            raise Refused(f"{where}: the port is taken; is a router or another node there? give another one") from None
        raise Refused(f"{where}: Zenoh can't open it ({reason}); give an endpoint such as tcp/localhost:7447") from None


class Publisher:
    """Publishes messages of one type on a topic, with what rmw_zenoh wants beside them."""

    def __init__(self, node: Node, topic: str, kind: str, qos: Qos) -> None:
        self.topic = topic
        self._type, self._messages, self._sequence = kind, node.messages, 0
        self._lock = threading.Lock()
        token, key = node.declare("MP", topic, kind, qos)
        self._gid = gid_of(token)
        if qos.transient_local:
            cache = zenoh.ext.CacheConfig(max_samples=qos.depth)
            detection = zenoh.ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=0.5)
            self._publisher: Any = zenoh.ext.declare_advanced_publisher(
                node.session, key, cache=cache, publisher_detection=True, sample_miss_detection=detection
            )
        else:
            drop = zenoh.CongestionControl.DROP
            self._publisher = node.session.declare_publisher(key, congestion_control=drop, express=True)

    def publish(self, message: Any) -> None:
        """Put a message on the wire; nobody is waited for."""
        data = self._messages.encode(message, self._type)
        with self._lock:
            self._sequence += 1
            self._publisher.put(data, attachment=attachment(self._sequence, time.time_ns(), self._gid))


class Node:
    """A node of the ROS graph.

    Args:
        session: Of Zenoh; the node does not close it.
        messages: Types of the distribution.
        domain: ROS domain.
        namespace: ``/`` or such as ``/robot``.
        name: Of the node.
    """

    def __init__(
        self, session: zenoh.Session, messages: Messages, domain: int = 0, namespace: str = "/", name: str = "node"
    ) -> None:
        self.session, self.messages, self.domain = session, messages, domain
        self.namespace, self.name = "/" + namespace.strip("/"), name
        self._zid, self._entity = str(session.zid()), 0
        self._tokens = [session.liveliness().declare_token(node_token(domain, self._zid, 0, self.namespace, name))]
        self._ears: list[Any] = []
        self._known: dict[str, Endpoint] = {}

    def full_name(self, topic: str) -> str:
        """The full name of a topic: ``~/reset`` is the node's own, ``imu`` its namespace's, ``/imu`` as it stands."""
        if topic.startswith("/"):
            return topic
        own = f"/{self.name}/{topic[2:]}" if topic.startswith("~/") else f"/{topic}"
        return self.namespace.rstrip("/") + own

    def declare(self, kind: str, topic: str, message: str, qos: Qos) -> tuple[str, str]:
        """Show an endpoint to the graph; returns its token and the key of its messages."""
        self._entity += 1
        known = (message, self.messages.type_hash(message))
        names = (self.namespace, self.name)
        token = endpoint_token(self.domain, self._zid, (0, self._entity), kind, names, topic, known, qos)
        self._tokens.append(self.session.liveliness().declare_token(token))
        return token, topic_key(self.domain, topic, *known)

    def publisher(self, topic: str, kind: str, qos: Qos | None = None) -> Publisher:
        """A publisher of messages of a ROS type."""
        return Publisher(self, self.full_name(topic), kind, qos or Qos())

    def subscribe(self, topic: str, kind: str, received: Received, qos: Qos | None = None) -> None:
        """Have ``received`` called with each message on a topic, of whatever type: it must not wait for anything."""
        full = self.full_name(topic)
        self.declare("MS", full, kind, qos or Qos())

        def hear(sample: zenoh.Sample) -> None:
            *_, found, type_hash = str(sample.key_expr).split("/")
            received(sample.payload.to_bytes(), ros_type(found), type_hash)

        key = topic_key(self.domain, full, "*", "*")
        self._ears.append(self.session.declare_subscriber(key, zenoh.handlers.Callback(hear, indirect=False)))

    def serve(self, name: str, kind: str, requested: Callable[[Answer], None]) -> None:
        """Offer a service of a ROS type without parameters: ``requested`` gets the answer to each request, and must not wait for anything."""
        full = self.full_name(name)
        _, key = self.declare("SS", full, kind, Qos())

        def hear(query: zenoh.Query) -> None:
            known = query.attachment and read_attachment(query.attachment.to_bytes())
            if not known:
                return  # no client of ROS

            def answer(data: bytes) -> None:
                with contextlib.suppress(zenoh.ZError), query:
                    query.reply(key, data, attachment=attachment(known[0], time.time_ns(), known[2]))

            requested(answer)

        ear = zenoh.handlers.Callback(hear, indirect=False)
        # clients of rmw_zenoh ask complete queryables alone
        self._ears.append(self.session.declare_queryable(key, ear, complete=True))

    def watch_graph(self) -> None:
        """Begin to know the endpoints of others."""

        def changed(sample: zenoh.Sample) -> None:
            key = str(sample.key_expr)
            if sample.kind == zenoh.SampleKind.DELETE:
                self._known.pop(key, None)
            elif (endpoint := parse_token(key)) is not None:
                self._known[key] = endpoint

        ear = zenoh.handlers.Callback(changed, indirect=False)
        everywhere = f"@ros2_lv/{self.domain}/**"
        self._ears.append(self.session.liveliness().declare_subscriber(everywhere, ear, history=True))

    def publishers(self) -> list[Endpoint]:
        """All publishers of the graph that are known now."""
        return [each for each in list(self._known.values()) if each.kind == "MP"]

    def close(self) -> None:
        """Leave the graph: undeclare what was declared."""
        for each in (*self._ears, *reversed(self._tokens)):
            with contextlib.suppress(zenoh.ZError):
                each.undeclare()
        self._ears, self._tokens = [], []
