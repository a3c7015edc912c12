"""Reads a recording that may be cut short or damaged: all records that pass their checksums, in order, and what is lost."""

from __future__ import annotations

import io
import json
import mmap
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from shared_store.wording import counted
from worker.telemetry import messages

if TYPE_CHECKING:
    from mcap.data_stream import ReadDataStream
    from mcap.records import McapRecord

CHANNELS = "channels.json"
"""Name of the attachment that repeats the table of channels, for a file with a damaged first chunk."""
CHECKSUM = "crc32"
"""Key of an episode's metadata: the checksum of the others, since MCAP has none there."""
_MAGIC = b"\x89MCAP0\r\n"
_HEADER, _FOOTER, _CHUNK, _INDEX, _ATTACHMENT, _METADATA, _DATA_END = 1, 2, 6, 7, 9, 12, 15
_OPCODES = range(1, 16)
_INDEX_BYTES = 9 + 2 + 4
"""Bytes of a chunk's index of one channel before its entries, of 16 bytes."""
_COMPRESSION = b"\x04\x00\x00\x00zstd"
_BEFORE_COMPRESSION = 9 + 8 + 8 + 8 + 4
"""Bytes of a chunk before the name of its compression: opcode, length, two times, size and checksum of its content."""
_LARGEST_CHUNK = 1 << 28
"""Bytes of a chunk's content; one message, such as a robot's meshes, may make a chunk long."""


def checksum(metadata: dict[str, str]) -> str:
    """The value of :data:`CHECKSUM` for an episode's metadata without it."""
    return f"{zlib.crc32(json.dumps(sorted(metadata.items())).encode()):08x}"


class SoundRecords:
    """The schemas, channels, messages, attachments and metadata of a file that pass their checksums.

    Iterating reads the file once, from its beginning; the attributes are right when that has ended.

    Args:
        path: The file.

    Attributes:
        found: Whether there was any record of a recording.
        whole: Whether the file ends as one that was finished, and nothing is damaged.
        damaged: Places at which something could not be read, without the cut at the end.
        lost: Messages in damaged chunks, as far as the indexes behind them count them.
        unreadable: Bytes of the damaged places.
        cut: Bytes at the end of a file that was cut short that belong to no whole record.

    Raises:
        OSError: The file can't be read.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.found = self.whole = False
        self.damaged = self.lost = self.unreadable = self.cut = 0
        self._known: set[int] = set()
        self._schemas: set[int] = set()

    def __iter__(self) -> Iterator[McapRecord]:
        with self.path.open("rb") as file:
            if not (size := file.seek(0, 2)):
                return
            with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
                yield from self._records(data, size)

    def _records(self, data: mmap.mmap, size: int) -> Iterator[McapRecord]:
        self._known, self._schemas = set(), set()
        place = len(_MAGIC) if data[: len(_MAGIC)] == _MAGIC else 0
        counting = False
        while place < size:
            opcode, end = _bounds(data, place, size)
            try:
                records = self._read(opcode, data[place + 9 : end]) if end <= size else None
            except Exception:  # zstandard, struct and mcap raise what they meet in damaged bytes
                records = None
            if records is None:
                end = self._next(data, place, end, size)
                if end > size:
                    self.cut = size - place
                    self.damaged += data[size - len(_MAGIC) :] == _MAGIC  # it was finished
                    return
                self.damaged, self.unreadable = self.damaged + 1, self.unreadable + end - place
                counting = opcode == _CHUNK  # the indexes behind it count its messages
            else:
                if opcode == _INDEX and counting:
                    self.lost += (end - place - _INDEX_BYTES) // 16
                counting = counting and opcode != _CHUNK
                self.found |= bool(records) or opcode == _HEADER
                yield from records
                if opcode == _FOOTER:
                    self._end(data, place, size)
                    return
            place = end

    def _end(self, data: mmap.mmap, footer: int, size: int) -> None:
        """Compare the checksums of a finished file's summary and of all that stands before it."""
        start, _, of_summary = struct.unpack_from("<QQI", data, footer + 9)
        data_end = start - 13
        sound = size == footer + 29 + len(_MAGIC) and 0 < data_end < footer and data[footer + 29 :] == _MAGIC
        if sound:
            of_data = int.from_bytes(data[data_end + 9 : start], "little")
            sound = zlib.crc32(data[start : footer + 25]) == of_summary
            sound &= of_data in (0, zlib.crc32(data[:data_end]))
        if not sound and not self.damaged:
            self.damaged = 1  # where nothing of the recording is, such as in an index
        self.whole = not self.damaged

    def _read(self, opcode: int, body: bytes) -> list[McapRecord]:
        """What a record holds. Raises whatever its damaged bytes cause."""
        from mcap.records import Attachment, Metadata

        if opcode == _CHUNK:
            return self._chunk(body)
        if opcode == _ATTACHMENT:
            _require(zlib.crc32(body[:-4]) == int.from_bytes(body[-4:], "little"))
            attachment = Attachment.read(_stream(body))
            return self._channels(attachment.data) if attachment.name == CHANNELS else [attachment]
        if opcode == _METADATA:
            metadata = Metadata.read(_stream(body))
            values = {key: value for key, value in metadata.metadata.items() if key != CHECKSUM}
            _require(metadata.metadata.get(CHECKSUM, checksum(values)) == checksum(values))
            return [metadata]
        if opcode == _INDEX:
            _require(len(body) - 6 == struct.unpack_from("<I", body, 2)[0] and len(body) % 16 == 6)
        elif opcode == _HEADER:
            _stream(body).read_prefixed_string()
        elif opcode in (_FOOTER, _DATA_END):
            _require(len(body) == {_FOOTER: 20, _DATA_END: 4}[opcode])
        else:
            _require(opcode in _OPCODES)  # of the summary
        return []

    def _chunk(self, body: bytes) -> list[McapRecord]:
        """The records of a chunk in which every message has a known channel; others are counted as lost."""
        from mcap.records import Channel, Chunk, Message, Schema
        from mcap.stream_reader import breakup_chunk

        chunk = Chunk.read(_stream(body))
        _require(chunk.compression == "zstd" and 0 < chunk.uncompressed_size <= _LARGEST_CHUNK)
        _require(len(body) == _BEFORE_COMPRESSION - 9 + len(_COMPRESSION) + 8 + len(chunk.data))
        kept = []
        for record in breakup_chunk(chunk, validate_crc=True):
            if isinstance(record, Schema):
                self._schemas.add(record.id)
            elif isinstance(record, Channel):
                if record.schema_id not in self._schemas:
                    continue  # the repeated table brings both
                self._known.add(record.id)
            elif isinstance(record, Message) and record.channel_id not in self._known:
                self.lost += 1
                continue
            kept.append(record)
        return kept

    def _channels(self, data: bytes) -> list[McapRecord]:
        """The records of the channels in the repeated table that no chunk has brought."""
        from mcap.records import Channel, Schema

        made: list[McapRecord] = []
        for row in json.loads(data):
            if row["id"] not in self._known:
                self._known.add(row["id"])
                self._schemas.add(row["schema_id"])
                text = messages.definition(row["type"]).encode()
                made.append(Schema(id=row["schema_id"], name=row["type"], encoding="ros2msg", data=text))
                known = {key: value for key, value in row.items() if key != "type"}
                made.append(Channel(message_encoding="cdr", **known))
        return made

    def _next(self, data: mmap.mmap, place: int, end: int, size: int) -> int:
        """Where the next record begins after a damaged one that seems to end at ``end``; more than ``size`` where there is none."""
        if end == size or (end < size and (self._is_sound(data, end, size) or _is_cut(data, end, size))):
            return end
        search = place + 1
        while (found := data.find(_COMPRESSION, search)) >= 0:
            if (begin := found - _BEFORE_COMPRESSION) > place and self._is_sound(data, begin, size):
                return begin
            search = found + 1
        return size + 1

    def _is_sound(self, data: mmap.mmap, place: int, size: int) -> bool:
        """Whether a record that can be read begins here."""
        opcode, end = _bounds(data, place, size)
        if end > size:
            return False
        probe = SoundRecords(self.path)
        try:
            probe._read(opcode, data[place + 9 : end])
        except Exception:
            return False
        return True

    def losses(self) -> str:
        """What is lost, in words; empty where it is the end of a file that was cut short, or nothing."""
        if not self.damaged:
            return ""
        places = f"damaged at {counted(self.damaged, 'place')} ({counted(self.unreadable, 'byte')})"
        return (
            f"{places}: at least {counted(self.lost, 'message')} lost"
            if self.lost
            else f"{places}: no message is known to be lost"
        )


def _bounds(data: mmap.mmap, place: int, size: int) -> tuple[int, int]:
    """Opcode and end of the record at a place. A chunk is known by its compression, too, if its opcode or length is damaged."""
    if place + 9 > size:
        return 0, size + 1
    inner = place + _BEFORE_COMPRESSION + len(_COMPRESSION)
    if data[place + _BEFORE_COMPRESSION : inner] == _COMPRESSION and inner + 8 <= size:
        end = inner + 8 + struct.unpack_from("<Q", data, inner)[0]
        if end <= size:
            return _CHUNK, end
    return data[place], place + 9 + struct.unpack_from("<Q", data, place + 1)[0]


def _is_cut(data: mmap.mmap, place: int, size: int) -> bool:
    """Whether a record begins here that the end of the file cuts off."""
    opcode, end = _bounds(data, place, size)
    return (
        data[place] in _OPCODES
        and (place + 9 > size or size < end < place + _LARGEST_CHUNK)
        and opcode in (0, data[place])
    )


def _stream(body: bytes) -> ReadDataStream:
    from mcap.data_stream import ReadDataStream

    return ReadDataStream(io.BytesIO(body))


def _require(holds: bool) -> None:
    if not holds:
        raise ValueError("damaged")
