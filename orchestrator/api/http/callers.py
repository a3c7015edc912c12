"""The caller of a local connection: the user at its other end.

A web server that listens on loopback is open to every user of the machine. While no key is demanded, requests are taken from
processes of the controller's own user alone, whatever they send. The command comes through a Unix socket, whose peer the kernel
names (``SO_PEERCRED``). Browsers and AWS's clients come over TCP, where it does not: there the kernel's table of sockets has the
user who opened the other end, and the two addresses and ports of a connection name one socket.
"""

from __future__ import annotations

import ipaddress
import pwd
import socket
import struct
from functools import cache
from pathlib import Path

from starlette.concurrency import run_in_threadpool

_TABLES = ("/proc/net/tcp", "/proc/net/tcp6")
_TRIES = 3
"""The kernel hands the table out in pieces, and a row may slip through while others come and go."""
Address = tuple[str, int]


class Caller:
    """The process at the other end of one connection."""

    def __init__(self, client: Address | None, server: Address | None, uid: int | None = None) -> None:
        """``client``, ``server``: IP address and port of its end and of ours; ``uid``: its user, where that is known already."""
        self._client, self._server, self._uid = client, server, uid
        self._is_known = uid is not None

    @classmethod
    def of_unix_socket(cls, connection: socket.socket) -> Caller:
        """The caller of a connection to a Unix socket."""
        return cls(None, None, struct.unpack("3i", connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, 12))[1])

    async def uid(self) -> int | None:
        """The user who opened the socket; None where this machine's table does not have it. Looked up once a connection.

        A socket that its process has closed already counts as absent: the kernel shows it as root's.
        """
        if not self._is_known and self._client and self._server:
            self._uid = await run_in_threadpool(_find, self._client, self._server)
            self._is_known = True
        return self._uid


def _find(client: Address, server: Address) -> int | None:
    return next(
        (uid for _ in range(_TRIES) for table in _TABLES if (uid := _user_in(table, client, server)) is not None), None
    )


def _user_in(table: str, client: Address, server: Address) -> int | None:
    try:
        content = Path(table).read_bytes()
    except OSError:
        return None
    for theirs, ours in zip(_forms(client), _forms(server), strict=False):
        start = content.find(f" {theirs} {ours} ".encode())
        if start >= 0:
            # state, queues, timer, retransmits, uid, timeout, inode
            fields = content[start:].split(b"\n", 1)[0].split()[2:]
            if fields[6] != b"0":  # else it has no owner any more
                return int(fields[4])
    return None


def _forms(address: Address) -> list[str]:
    """The forms in which the table may show an address and port: IPv4 and IPv6, in words of the machine's byte order."""
    ip = ipaddress.ip_address(address[0].partition("%")[0])
    if isinstance(ip, ipaddress.IPv6Address) and ip.ipv4_mapped:
        ip = ip.ipv4_mapped
    forms = [ip.packed] if ip.version == 6 else [ip.packed, bytes(10) + b"\xff\xff" + ip.packed]
    words = [struct.unpack(f"={len(form) // 4}I", form) for form in forms]
    return ["".join(f"{word:08X}" for word in form) + f":{address[1]:04X}" for form in words]


@cache
def user_name(uid: int) -> str:
    """The name of a user, or the number of one without a name. Looked up once: a directory server may be slow."""
    try:
        return pwd.getpwuid(uid).pw_name
    except KeyError:
        return f"with uid {uid}"
