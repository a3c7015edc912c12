"""The caller of a loopback connection: the user at its other end, from the kernel's table of sockets.

A web server that listens on loopback is open to every user of the machine. While no key is demanded, requests are taken from
processes of the controller's own user alone, whatever they send. Another user's process can't pretend: the table has the user
who opened the socket, and the two addresses and ports of a connection name one socket.
"""

from __future__ import annotations

import ipaddress
import pwd
import struct
from functools import cache
from pathlib import Path

from starlette.concurrency import run_in_threadpool

_TABLES = ("/proc/net/tcp", "/proc/net/tcp6")
_LOOKS = 3
"""The kernel gives the table out in pieces, and a row may slip through while others come and go."""
Address = tuple[str, int]


class Caller:
    """The process at the other end of one connection."""

    def __init__(self, client: Address, server: Address) -> None:
        """``client``, ``server``: IP address and port of its end and of ours."""
        self._client, self._server = client, server
        self._uid: int | None = None
        self._is_known = False

    async def uid(self) -> int | None:
        """The user who opened the socket; None where this machine's table does not have it. Looked up once a connection.

        A socket that its process has closed already counts as not there: the kernel shows it as root's.
        """
        if not self._is_known:
            self._uid = await run_in_threadpool(self._find)
            self._is_known = True
        return self._uid

    def _find(self) -> int | None:
        for _ in range(_LOOKS):
            for table in _TABLES:
                if (uid := self._look(Path(table))) is not None:
                    return uid
        return None

    def _look(self, table: Path) -> int | None:
        try:
            content = table.read_bytes()
        except OSError:
            return None
        for client, server in zip(_forms(self._client), _forms(self._server), strict=False):
            start = content.find(f" {client} {server} ".encode())
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
