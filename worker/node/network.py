"""Which network interface holds a node's address: what NCCL and Gloo must be told where a host has several."""

from __future__ import annotations

import fcntl
import ipaddress
import socket
import struct

_SIOCGIFADDR = 0x8915


def interface_of(address: str | None, peer: str) -> str | None:
    """Name of the interface that holds ``address``, or, without one, of that which leads to ``peer``; None if none does."""
    try:
        found = ipaddress.ip_address(address or address_towards(peer))
    except (OSError, ValueError):
        return None
    if found.is_loopback:
        return "lo"  # the whole of 127.0.0.0/8 is on it
    for _, name in socket.if_nameindex():
        if _address_on(name) == str(found):
            return name
    return None


def address_towards(peer: str) -> str:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.connect((peer, 9))  # sends nothing: it only asks the kernel for the route
        return str(probe.getsockname()[0])


def _address_on(interface: str) -> str | None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            reply = fcntl.ioctl(probe.fileno(), _SIOCGIFADDR, struct.pack("256s", interface.encode()[:15]))
        except OSError:
            return None
    return socket.inet_ntoa(reply[20:24])
