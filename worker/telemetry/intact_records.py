"""The intact records of a recording that may be cut short or damaged: all that pass their checksums, in order, and what is lost."""

from __future__ import annotations

import heapq
import io
import json
import mmap
import re
import struct
import zlib
from collections import defaultdict
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from shared_store.contract.error_text import counted
from worker.telemetry import messages

if TYPE_CHECKING:
    from mcap.data_stream import ReadDataStream
    from mcap.records import McapRecord


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

    0 where the bytes aren't a single record.
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

    def opening(at: int) -> int:
        # a match that a suspended generator held would keep the file's map open
        found = _BEGIN.search(data, at)
        return found.start() if found else -1

    def found_by(find: Callable[[int], int], before: int) -> Iterator[int]:
        at = start + before
        while (at := find(at)) >= 0:
            yield at - before
            at += 1

    chunks = found_by(partial(data.find, COMPRESSION), 9 + _BEFORE_COMPRESSION)
    return heapq.merge(found_by(opening, 0), chunks)


CHANNELS = "channels.json"
"""Name of the attachment that repeats the table of channels, for a file with a damaged first chunk."""
LIBRARY = "muster 2"
"""Library in the header of a recording in which all metadata have a checksum."""
_UNCHECKED = "muster"
"""Library of earlier recordings, whose metadata have none that holds."""
_CHECKSUM = "crc32"
"""Key of the metadata's checksum, since MCAP has none there."""
_MAGIC = b"\x89MCAP0\r\n"
_LARGEST_CHUNK = 1 << 28
"""Bytes of a chunk's content; one message, such as a robot's meshes, may make a chunk long."""


def with_checksum(name: str, values: dict[str, str]) -> dict[str, str]:
    """Metadata of this name with these values, and their checksum in place of any that they have."""
    own = {key: value for key, value in values.items() if key != _CHECKSUM}
    return {**own, _CHECKSUM: f"{zlib.crc32(json.dumps([name, sorted(own.items())]).encode()):08x}"}


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
        self._lost_attachments: list[str] = []
        self._lost_metadata = 0
        self._uncounted = self._pending = self._behind = False
        """Whether a chunk is lost that no index counts, one whose indexes may follow, and anything since the last sound chunk."""
        self._chunks: set[bytes] = set()
        """Times, size and checksum of the sound chunks."""
        self._known: set[int] = set()
        self._schemas: set[int] = set()
        self._listed: defaultdict[int, list[int]] = defaultdict(list)
        """Times of the last sound chunk's messages by channel."""
        self._checked, self._ended = True, False

    def __iter__(self) -> Iterator[McapRecord]:
        with self.path.open("rb") as file:
            if not (size := file.seek(0, 2)):
                return
            with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
                yield from self._records(data, size)
                self._uncounted |= self._pending

    def _records(self, data: mmap.mmap, size: int) -> Iterator[McapRecord]:
        place = len(_MAGIC) if data[: len(_MAGIC)] == _MAGIC else 0
        summary = _summary(data, size)
        while place < size:
            self._ended |= place == summary > 0
            if (read := self._try(data, place, size)) is None:
                end = next((each for each in places(data, place + 1) if self._is_sound(data, each, size)), size + 1)
                if end > size and (end := self._last(data, place, size, summary)) > size:
                    self.cut = size - place
                    return
                self._lose(data, place, end)
            else:
                opcode, end, records = read
                if opcode == INDEX:
                    self._count(data, place, end)
                elif opcode == CHUNK:
                    self._uncounted |= self._pending
                    self._pending = self._behind = False
                self.found |= bool(records) or opcode == HEADER
                yield from records
                if opcode == FOOTER:
                    self._end(data, place, size)
                    return
            place = end

    def _try(self, data: mmap.mmap, place: int, size: int) -> tuple[int, int, list[McapRecord]] | None:
        """Opcode, end and content of the record at a place; None where none can be read."""
        for opcode, end in _bounds(data, place, size):
            if end <= size:
                try:
                    return opcode, end, self._read(opcode, data[place + 9 : end])
                except Exception:  # zstandard, struct and mcap raise what they meet in damaged bytes
                    continue
        return None

    def _is_sound(self, data: mmap.mmap, place: int, size: int) -> bool:
        """Whether a record that can be read begins here."""
        probe = SoundRecords(self.path)
        probe._checked = self._checked
        return probe._try(data, place, size) is not None

    def _last(self, data: mmap.mmap, place: int, size: int, summary: int) -> int:
        """Where the damage ends that begins at a place, with no sound record behind it; more than ``size`` if it is a cut alone."""
        if data[size - len(_MAGIC) :] == _MAGIC:  # it was finished
            return summary if place < summary else size
        if self._is_cut(data, place, size):
            return size + 1
        ends = [end for _, end in _bounds(data, place, size) if end < size]
        started = [each for each in (*ends, *places(data, place + 1)) if self._is_cut(data, each, size)]
        return min(started, default=size)

    def _is_cut(self, data: mmap.mmap, place: int, size: int) -> bool:
        """Whether a record begins here that the end of the file cuts off."""
        opcode, length = data[place], int.from_bytes(data[place + 1 : place + 9], "little")
        if place + 9 > size:
            return opcode in (HEADER, CHUNK, INDEX, ATTACHMENT, METADATA, DATA_END) or self._ended
        return place + 9 + length > size and fits(opcode, length, data[place + 9 : place + 9 + length], self._ended)

    def _lose(self, data: mmap.mmap, place: int, end: int) -> None:
        """Count what is lost between two places."""
        self.damaged, self.unreadable, self._behind = self.damaged + 1, self.unreadable + end - place, True
        if self._ended:
            return  # the summary repeats what stands before it
        opcode, name = identify(data[place:end])
        if opcode == ATTACHMENT:
            self._lost_attachments += [name] if name != CHANNELS else []
        elif opcode == METADATA:
            self._lost_metadata += 1
        elif opcode not in (INDEX, HEADER, DATA_END):
            self._uncounted |= self._pending
            self._pending = True

    def _count(self, data: mmap.mmap, place: int, end: int) -> None:
        """Count the messages of an index whose chunk is lost. One that contradicts a sound chunk is damaged itself."""
        channel, _ = struct.unpack_from("<HI", data, place + 9)
        times = [time for time, _ in struct.iter_unpack("<QQ", data[place + 15 : end])]
        if sorted(times) == sorted(self._listed.get(channel, [])):
            return
        if self._behind:
            self.lost += len(times)
            self._pending = False
        else:
            self.damaged, self.unreadable = self.damaged + 1, self.unreadable + end - place

    def _end(self, data: mmap.mmap, footer: int, size: int) -> None:
        """Compare the checksums of a finished file's summary and of all that stands before it."""
        start, _, of_summary = struct.unpack_from("<QQI", data, footer + 9)
        data_end, tail = start - 13, data[footer + 29 :]
        sound = 0 < data_end < footer and _MAGIC.startswith(tail)
        if sound:
            of_data = int.from_bytes(data[data_end + 9 : start], "little")
            sound = zlib.crc32(data[start : footer + 25]) == of_summary
            sound &= of_data in (0, zlib.crc32(data[:data_end]))
        if not sound and not self.damaged:
            self.damaged = 1  # where nothing of the recording is, such as in an index
        self.whole = not self.damaged and tail == _MAGIC

    def _read(self, opcode: int, body: bytes) -> list[McapRecord]:
        """What a record holds. Raises whatever its damaged bytes cause."""
        from mcap.data_stream import RecordBuilder
        from mcap.records import Attachment, Header, Metadata

        if opcode == CHUNK:
            return self._chunk(body)
        _require(fits(opcode, len(body), body, self._ended))
        if opcode == ATTACHMENT:
            _require(zlib.crc32(body[:-4]) == int.from_bytes(body[-4:], "little"))
            attachment = Attachment.read(_stream(body))
            return self._channels(attachment.data) if attachment.name == CHANNELS else [attachment]
        if opcode == METADATA:
            metadata = Metadata.read(_stream(body))
            metadata.write(builder := RecordBuilder())
            _require(builder.end()[9:] == body)
            _require(not self._checked or metadata.metadata == with_checksum(metadata.name, metadata.metadata))
            return [metadata]
        if opcode == HEADER:
            self._checked = Header.read(_stream(body)).library != _UNCHECKED
        self._ended |= opcode == DATA_END
        return []

    def _chunk(self, body: bytes) -> list[McapRecord]:
        """The records of a chunk in which every message has a known channel; others are counted as lost."""
        import zstandard
        from mcap.records import Channel, Chunk, Message, Schema
        from mcap.stream_reader import breakup_chunk

        start, end, size, crc = struct.unpack_from("<QQQI", body)
        _require(body[28 : 28 + len(COMPRESSION)] == COMPRESSION and 0 < size <= _LARGEST_CHUNK)
        frame = body[CHUNK_BODY:]  # not by the length before it: if the record's own differs, the frame decides
        _require(zstandard.get_frame_parameters(frame).content_size == size)
        decompressor = zstandard.ZstdDecompressor().decompressobj()
        content = decompressor.decompress(frame)
        _require(decompressor.eof and not decompressor.unused_data and len(content) == size)
        _require(zlib.crc32(content) == crc)
        if body[:28] in self._chunks:  # the same messages once more
            self.damaged, self.unreadable = self.damaged + 1, self.unreadable + len(body)
            return []
        self._chunks.add(body[:28])
        kept, self._listed = [], defaultdict(list)
        for record in breakup_chunk(Chunk("", content, end, start, crc, size)):
            if isinstance(record, Schema):
                self._schemas.add(record.id)
            elif isinstance(record, Channel):
                if record.schema_id not in self._schemas:
                    continue  # the repeated table brings both
                self._known.add(record.id)
            elif isinstance(record, Message):
                self._listed[record.channel_id].append(record.log_time)
                if record.channel_id not in self._known:
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

    def losses(self) -> str:
        """What is lost, in words; empty where it is the end of a file that was cut short, or nothing."""
        if not self.damaged:
            return ""
        lost = [f"at least {counted(self.lost, 'message')}"] if self.lost else []
        if self._uncounted:
            lost.append(f"an unknown number of {'further messages' if lost else 'messages'}")
        lost += [f"the record of {counted(self._lost_metadata, 'episode')}"] if self._lost_metadata else []
        lost += [f"attachment {name}".strip() for name in self._lost_attachments]
        places = f"damaged at {counted(self.damaged, 'place')} ({counted(self.unreadable, 'byte')})"
        return f"{places}: {' and '.join(lost)} lost" if lost else f"{places}: nothing is known to be lost"


def _summary(data: mmap.mmap, size: int) -> int:
    """Where the summary of a finished file begins; 0 where there is none, or it is damaged."""
    if size < 37 + len(_MAGIC):
        return 0
    start, crc = struct.unpack_from("<Q", data, size - 28)[0], struct.unpack_from("<I", data, size - 12)[0]
    return start if 0 < start < size - 37 and zlib.crc32(data[start : size - 12]) == crc else 0


def _bounds(data: mmap.mmap, place: int, size: int) -> list[tuple[int, int]]:
    """Opcode and end of the record that may be at a place. A chunk is known by its compression, too, and has its length twice."""
    if place + 9 > size:
        return []
    bounds = [(data[place], place + 9 + struct.unpack_from("<Q", data, place + 1)[0])]
    inner = place + 9 + CHUNK_BODY
    if data[inner - 8 - len(COMPRESSION) : inner - 8] == COMPRESSION and inner <= size:
        bounds += [(CHUNK, bounds[0][1]), (CHUNK, inner + struct.unpack_from("<Q", data, inner - 8)[0])]
    return list(dict.fromkeys(bounds))


def _stream(body: bytes) -> ReadDataStream:
    from mcap.data_stream import ReadDataStream

    return ReadDataStream(io.BytesIO(body))


def _require(holds: bool) -> None:
    if not holds:
        raise ValueError("damaged")
