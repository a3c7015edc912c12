"""Two hosts on one machine, and the wire between them: network namespaces, and a relay of packets that can be slow, lossy or cut.

The kernel's own emulator (netem) is a module that many kernels lack; a TUN device on each side and a process between them is not.
"""

from __future__ import annotations

import contextlib
import ctypes
import fcntl
import heapq
import os
import random
import select
import struct
import subprocess
import sys
import time
from collections.abc import Sequence

_TUNSETIFF, _IFF_TUN, _IFF_NO_PI, _CLONE_NEWNET = 0x400454CA, 1, 0x1000, 0x40000000
ADDRESSES = ("10.77.0.1", "10.77.0.2")


class Link:
    """Namespaces ``<name>0`` and ``<name>1`` with :data:`ADDRESSES`, joined by a relay."""

    def __init__(self, name: str) -> None:
        """Raises OSError where this machine has no namespaces or TUN devices, or this process is not root."""
        self.hosts = [f"{name}{side}" for side in (0, 1)]
        for host in self.hosts:
            if subprocess.run(["ip", "netns", "add", host], capture_output=True).returncode:
                raise OSError(f"ip netns add {host} failed")
        command = [sys.executable, "-P", __file__, *self.hosts]
        self._relay = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        assert self._relay.stdout is not None
        if self._relay.stdout.readline() != "ready\n":
            self.close()
            raise OSError("no TUN device can be made")

    def order(self, what: str) -> None:
        """``loss 0.05`` (share of packets), ``delay 0.2`` (seconds, each way), ``cut``, ``clear``."""
        assert self._relay.stdin is not None
        self._relay.stdin.write(f"{what}\n")
        self._relay.stdin.flush()

    def inside(self, side: int, command: Sequence[str]) -> list[str]:
        """``command`` on the host of that side."""
        return ["ip", "netns", "exec", self.hosts[side], *command]

    def close(self) -> None:
        self._relay.kill()
        self._relay.wait()
        for host in self.hosts:
            subprocess.run(["ip", "netns", "del", host], capture_output=True)


def _open(host: str, address: str) -> int:
    """A TUN device in the namespace ``host``, up, with ``address``; its descriptor works from anywhere."""
    libc = ctypes.CDLL(None, use_errno=True)
    with open(f"/var/run/netns/{host}") as namespace:
        if libc.setns(namespace.fileno(), _CLONE_NEWNET):
            raise OSError(ctypes.get_errno(), f"setns {host}")
    tun = os.open("/dev/net/tun", os.O_RDWR)
    fcntl.ioctl(tun, _TUNSETIFF, struct.pack("16sH22x", b"wire", _IFF_TUN | _IFF_NO_PI))
    for command in (f"addr add {address}/24 dev wire", "link set wire up", "link set lo up"):
        subprocess.run(["ip", *command.split()], check=True)
    return tun


def _relay(hosts: Sequence[str]) -> None:
    sides = [_open(host, address) for host, address in zip(hosts, ADDRESSES, strict=True)]
    print("ready", flush=True)
    loss, delay, orders = 0.0, 0.0, ""
    waiting: list[tuple[float, int, int, bytes]] = []
    number = 0
    while True:
        pause = max(0.0, waiting[0][0] - time.monotonic()) if waiting else None
        ready, _, _ = select.select([*sides, 0], [], [], pause)
        if 0 in ready:
            if not (chunk := os.read(0, 4096)):
                return
            *lines, orders = (orders + chunk.decode()).split("\n")
            for order in lines:
                what, _, value = order.partition(" ")
                loss = {"loss": float(value or 0), "cut": 1.0, "clear": 0.0}.get(what, loss)
                delay = {"delay": float(value or 0), "clear": 0.0}.get(what, delay)
        for side in (0, 1):
            if sides[side] in ready:
                packet = os.read(sides[side], 65536)
                number += 1
                if random.random() >= loss:
                    heapq.heappush(waiting, (time.monotonic() + delay, number, sides[1 - side], packet))
        while waiting and waiting[0][0] <= time.monotonic():
            _, _, tun, packet = heapq.heappop(waiting)
            with contextlib.suppress(OSError):
                os.write(tun, packet)


if __name__ == "__main__":
    _relay(sys.argv[1:])
