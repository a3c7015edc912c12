"""The rendezvous port of a gang (``MASTER_PORT``): free on all addresses of the host, in a range that few other gangs share."""

from __future__ import annotations

import hashlib
import socket

_FIRST, _SLOTS, _EACH = 20000, 600, 20
"""600 ranges of 20 ports, all below Linux's ephemeral ports (from 32768)."""


def first_port(gang: str | int) -> int:
    """The first port of a gang's range, 20000 to 31980, from its name, or from a number, which gives consecutive gangs different ranges."""
    number = gang if isinstance(gang, int) else int.from_bytes(hashlib.sha256(gang.encode()).digest()[:4], "big")
    return _FIRST + number % _SLOTS * _EACH


def free_port(gang: str | int) -> int:
    """The first port of a gang's range on which no process of this host listens, at any address.

    ``torch.distributed.init_process_group`` listens on all addresses at once, so a port is not free for it even if another gang
    listens there on one address only. Raises OSError if none is free.
    """
    first = first_port(gang)
    for port in range(first, first + _EACH):
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind(("", port))
                return port
            except OSError:
                continue
    raise OSError(f"no free port from {first} to {first + _EACH - 1}")
