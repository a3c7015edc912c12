"""rmw_zenoh's wire: key expressions, liveliness tokens, QoS strings, attachments and gids, as bytes and text.

As of rmw_zenoh for Humble (no type hashes), Jazzy, Kilted and Lyrical.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

import xxhash

NO_HASH = "TypeHashNotSupported"
"""Stands for the type hash in ROS 2 Humble, which has none."""
ADMIN = "@ros2_lv"
_ATTACHMENT = struct.Struct("<qqB16s")


@dataclass(frozen=True)
class Qos:
    """Quality of service of an endpoint; other settings are ROS 2's defaults.

    Attributes:
        depth: Number of messages to keep.
        transient_local: Whether late subscribers get the last messages; else volatile.
    """

    depth: int = 10
    transient_local: bool = False

    def __str__(self) -> str:
        """``reliability:durability:history,depth:deadline:lifespan:liveliness``, with what is default left out."""
        return f":{'1' if self.transient_local else ''}:,{self.depth}:,:,:,,"


@dataclass(frozen=True)
class Endpoint:
    """An endpoint or a node, from a liveliness token.

    Attributes:
        kind: ``NN`` node, ``MP`` publisher, ``MS`` subscription, ``SS`` service, ``SC`` client.
        node: Its full name, such as ``/robot/driver``.
        name: Of the topic or service; empty for a node.
        type: ROS type, such as ``sensor_msgs/msg/Imu``; empty for a node.
        type_hash: As in the token; empty for a node.
    """

    kind: str
    node: str
    name: str = ""
    type: str = ""
    type_hash: str = ""


def dds_type(name: str) -> str:
    """``sensor_msgs::msg::dds_::Imu_`` of ``sensor_msgs/msg/Imu``."""
    package, folder, kind = name.split("/")
    return f"{package}::{folder}::dds_::{kind}_"


def ros_type(name: str) -> str:
    """``sensor_msgs/msg/Imu`` of ``sensor_msgs::msg::dds_::Imu_``; other names stay unchanged."""
    parts = name.split("::")
    if len(parts) == 4 and parts[2] == "dds_":
        return f"{parts[0]}/{parts[1]}/{parts[3].removesuffix('_')}"
    return name


def topic_key(domain: int, topic: str, kind: str, type_hash: str) -> str:
    """The key on which messages of a topic are put, or a service is asked.

    Args:
        domain: ROS domain.
        topic: Full name, such as ``/robot/joint_states``; its inner slashes stay.
        kind: ROS type; ``*`` for any.
        type_hash: ``RIHS01_…``; ``*`` for any.
    """
    return f"{domain}/{topic.strip('/')}/{kind if kind == '*' else dds_type(kind)}/{type_hash}"


def mangled(name: str) -> str:
    """A name as a chunk of a token: each slash becomes ``%``; an empty one is ``%``."""
    return name.replace("/", "%") or "%"


def node_token(domain: int, session: str, node_id: int, namespace: str, node: str) -> str:
    """The liveliness token of a node; the enclave is the root.

    Args:
        domain: ROS domain.
        session: Id of the Zenoh session.
        node_id: Of the node in the session.
        namespace: ``/`` or such as ``/robot``.
        node: Its name, without the namespace.
    """
    return f"{ADMIN}/{domain}/{session}/{node_id}/{node_id}/NN/%/{mangled(namespace)}/{mangled(node)}"


def endpoint_token(
    domain: int,
    session: str,
    ids: tuple[int, int],
    kind: str,
    names: tuple[str, str],
    topic: str,
    message: tuple[str, str],
    qos: Qos,
) -> str:
    """The liveliness token of a publisher, a subscription or a service.

    Args:
        domain: ROS domain.
        session: Id of the Zenoh session.
        ids: Of the node and of the endpoint in the session.
        kind: ``MP``, ``MS`` or ``SS``.
        names: Namespace and name of the node.
        topic: Full name.
        message: ROS type and type hash.
        qos: Quality of service.
    """
    (node_id, entity), (namespace, node), (name, type_hash) = ids, names, message
    return (
        f"{ADMIN}/{domain}/{session}/{node_id}/{entity}/{kind}/%/{mangled(namespace)}/{mangled(node)}/"
        f"{mangled(topic)}/{dds_type(name)}/{type_hash}/{qos}"
    )


def parse_token(key: str) -> Endpoint | None:
    """The endpoint of a liveliness token; None for any other form.

    Further fields at its end are ignored: those of Lyrical have one more, for buffer backends.
    """
    parts = key.split("/")
    if len(parts) < 9 or parts[0] != ADMIN or any(not part for part in parts[:9]):
        return None
    kind, namespace, node = parts[5], parts[7].replace("%", "/"), parts[8].replace("%", "/")
    full = f"{namespace.rstrip('/')}/{node}"
    if kind == "NN":
        return Endpoint(kind, full)
    if kind not in ("MP", "MS", "SS", "SC") or len(parts) < 13:
        return None
    return Endpoint(kind, full, parts[9].replace("%", "/"), ros_type(parts[10]), parts[11])


def gid_of(token: str) -> bytes:
    """The 16-byte id of an endpoint: XXH3-128 of its liveliness token, low half first."""
    return xxhash.xxh3_128_intdigest(token.encode()).to_bytes(16, "little")


def attachment(sequence: int, nanoseconds: int, gid: bytes) -> bytes:
    """The attachment of each message, 33 bytes: rmw_zenoh drops messages without it.

    Args:
        sequence: Number of the message, from 1.
        nanoseconds: Source time [ns since 1970].
        gid: Of the publisher, 16 bytes.
    """
    return _ATTACHMENT.pack(sequence, nanoseconds, len(gid), gid)


def read_attachment(data: bytes) -> tuple[int, int, bytes] | None:
    """Sequence number, source time [ns] and gid of a message; None for other attachments than rmw_zenoh's."""
    if len(data) != _ATTACHMENT.size:
        return None
    sequence, nanoseconds, length, gid = _ATTACHMENT.unpack(data)
    return (sequence, nanoseconds, gid) if length == 16 else None
