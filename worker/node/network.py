"""Which network interface holds a node's address: what NCCL and Gloo must be told where a host has several."""

from __future__ import annotations

import ipaddress
import socket

import psutil


def interface_of(address: str | None, peer: str) -> str | None:
    """Name of the interface that holds ``address``, or, without one, of that which leads to ``peer``; None if none does."""
    try:
        found = ipaddress.ip_address(address or address_towards(peer))
    except (OSError, ValueError):
        return None
    if found.is_loopback:
        return "lo"  # the whole of 127.0.0.0/8 is on it
    interfaces = psutil.net_if_addrs().items()
    return next((name for name, held in interfaces if any(each.address == str(found) for each in held)), None)


def address_towards(peer: str) -> str:
    """This node's IPv4 address on the route to ``peer``. Raises OSError."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.connect((peer, 9))  # sends nothing: it only asks the kernel for the route
        return str(probe.getsockname()[0])
