"""Messages of AWS's event streams (``application/vnd.amazon.eventstream``): framed, with checksums of prelude and message."""

from __future__ import annotations

import json
import struct
from typing import Any
from zlib import crc32

_STRING = 7
"""Type number of a header whose value is a string."""


def encode(headers: dict[str, str], payload: bytes) -> bytes:
    """One message: lengths, their CRC-32, headers, payload, CRC-32 of all before; integers are big-endian."""
    packed = b"".join(
        struct.pack("!B", len(name)) + name.encode() + struct.pack("!BH", _STRING, len(value.encode())) + value.encode()
        for name, value in headers.items()
    )
    lengths = struct.pack("!II", 16 + len(packed) + len(payload), len(packed))
    body = lengths + struct.pack("!I", crc32(lengths)) + packed + payload
    return body + struct.pack("!I", crc32(body))


def event(kind: str, content: dict[str, Any]) -> bytes:
    """An event of type ``kind`` with a JSON payload."""
    return _message("event", "event", kind, content)


def exception(kind: str, message: str) -> bytes:
    """A modelled exception inside the stream; the client raises it."""
    return _message("exception", "exception", kind, {"message": message})


def _message(message_type: str, what: str, kind: str, content: dict[str, Any]) -> bytes:
    headers = {":message-type": message_type, f":{what}-type": kind, ":content-type": "application/json"}
    return encode(headers, json.dumps(content).encode())
