"""The lengths within MCAP records, by which a record is known whose content is damaged or cut off."""

from __future__ import annotations

import heapq
import mmap
import re
from collections.abc import Iterator

HEADER, FOOTER, CHUNK, INDEX, ATTACHMENT, METADATA, DATA_END = 1, 2, 6, 7, 9, 12, 15
_SUMMARY = (3, 4, 8, 10, 11, 13, 14)
"""Schemas and channels, which a recording has in chunks else, statistics and indexes of the file."""
COMPRESSION = b"\x04\x00\x00\x00zstd"
_BEFORE_COMPRESSION = 8 + 8 + 8 + 4
"""Bytes of a chunk's body before the name of its compression: two times, size and checksum of its content."""
CHUNK_BODY = _BEFORE_COMPRESSION + len(COMPRESSION) + 8
"""Bytes of a chunk's body before its compressed content."""
_LARGEST = 1 << 32
_BEGIN = re.compile(rb"[\x01\x07\x09\x0c\x0f][\x00-\xff]{4}\x00{4}")


def fits(opcode: int, length: int, body: bytes, ended: bool) -> bool:
    """Whether the lengths inside a record agree with its own.

    Args:
        opcode: Its kind. Those of a summary and the footer fit only behind the end of the data.
        length: Of its body [bytes].
        body: As much of it as there is; lengths beyond its end are taken to agree.
        ended: Whether the end of the data was read.
    """
    if opcode in _SUMMARY or opcode == FOOTER:
        return ended and (opcode != FOOTER or length == 20)
    if opcode == DATA_END:
        return length == 4
    if opcode == CHUNK:
        name = body[_BEFORE_COMPRESSION : _BEFORE_COMPRESSION + len(COMPRESSION)]
        if not COMPRESSION.startswith(name):
            return False
    before = {
        HEADER: (0, 4, 4),
        CHUNK: (CHUNK_BODY - 8, 8),
        INDEX: (2, 4),
        METADATA: (0, 4, 4),
        ATTACHMENT: (16, 4, 4, 8),
    }
    if opcode not in before or length >= _LARGEST:
        return False
    place, *widths = before[opcode]
    for width in widths:
        if place + width > length:
            return False
        if place + width > len(body):
            return True
        place += width + int.from_bytes(body[place : place + width], "little")
    return length == place + (4 if opcode == ATTACHMENT else 0) and (opcode != INDEX or length % 16 == 6)


def identify(record: bytes) -> tuple[int, str]:
    """Opcode of a damaged record by the lengths inside it, or else by its own opcode and length, and an attachment's name.

    0 where the bytes are no single record.
    """
    body = record[9:]
    kinds = (CHUNK, ATTACHMENT, METADATA, INDEX, DATA_END)
    found = next((kind for kind in kinds if fits(kind, len(body), body, ended=False)), 0)
    if not found and int.from_bytes(record[1:9], "little") == len(body) and record[0] in (*kinds, HEADER):
        found = record[0]
    if found != ATTACHMENT:
        return found, ""
    name = body[20 : 20 + int.from_bytes(body[16:20], "little")].decode(errors="replace")
    return found, name if name.isprintable() else ""


def places(data: mmap.mmap, start: int) -> Iterator[int]:
    """Where a record may begin, from ``start`` on, in order; all but those of the summary."""
    return heapq.merge(_openings(data, start), _chunks(data, start))


def _openings(data: mmap.mmap, start: int) -> Iterator[int]:
    while (start := _opening(data, start)) >= 0:
        yield start
        start += 1


def _opening(data: mmap.mmap, start: int) -> int:
    # a match that a suspended generator held would keep the file's map open
    found = _BEGIN.search(data, start)
    return found.start() if found else -1


def _chunks(data: mmap.mmap, start: int) -> Iterator[int]:
    before = 9 + _BEFORE_COMPRESSION
    search = start + before
    while (found := data.find(COMPRESSION, search)) >= 0:
        yield found - before
        search = found + 1
