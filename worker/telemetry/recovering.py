"""Makes a readable file of a recording that was cut short or damaged."""

from __future__ import annotations

import os
from pathlib import Path
from typing import NamedTuple

from worker.settings.errors import UserError
from worker.telemetry.intact_records import LIBRARY, SoundRecords, with_checksum
from worker.telemetry.recording import CHUNK, PARTIAL, writer_to


class Recovered(NamedTuple):
    """What :func:`recover` made."""

    path: Path
    """The readable file."""
    messages: int
    losses: str
    """What is lost, in words; empty where nothing is but the end of a file that was cut short."""


def recover(partial: Path) -> Recovered | None:
    """Make a readable file of one that was cut short or damaged, beside it.

    All chunks that pass their checksums are kept, also behind a damaged one. The file itself stays as it is. Of a file that is whole
    nothing is made: None.

    Raises:
        UserError: There is no such file, or no control step in it can be read.
    """
    if not partial.is_file():
        why = "it is not a file" if partial.exists() else "there is no such file"
        raise UserError(f"{partial}: {why}; a recording that was cut short ends on .mcap{PARTIAL}")
    if not os.access(partial, os.R_OK):
        raise UserError(f"{partial}: it can't be read (Permission denied)")
    name = partial.name.removesuffix(PARTIAL)
    target = partial.with_name(name if name != partial.name else f"{partial.stem}-recovered{partial.suffix}")
    if target.exists():
        raise UserError(f"{target}: it exists already; move it away first")
    hidden = target.with_name(f".{target.name}.tmp")
    records = SoundRecords(partial)
    try:
        count, steps = _copy(records, hidden)
        if records.whole:
            return None
        if not steps:
            if not records.found:
                raise UserError(f"{partial}: it has no readable record of an MCAP file; there is nothing to recover")
            why = records.losses() or "it ends before the first control step"
            raise UserError(f"{partial}: {why}; there is no control step to recover")
        os.replace(hidden, target)
    except OSError as error:
        raise UserError(f"{target}: it can't be written ({error.strerror or error})") from error
    finally:
        hidden.unlink(missing_ok=True)
    return Recovered(target, count, records.losses())


def _copy(records: SoundRecords, target: Path) -> tuple[int, int]:
    """Write all sound records to a file; returns the numbers of messages and of control steps."""
    from mcap.records import Attachment, Channel, Message, Metadata, Schema

    schemas: dict[int, int] = {}
    channels: dict[int, int] = {}
    stepping: set[int] = set()
    count = steps = size = 0
    with target.open("wb") as file:
        writer = writer_to(file)
        writer.start("ros2", LIBRARY)
        for record in records:
            match record:
                case Schema():
                    if record.id not in schemas:
                        schemas[record.id] = writer.register_schema(record.name, record.encoding, record.data)
                case Channel():
                    if record.id not in channels:
                        own = record.topic, record.message_encoding, schemas[record.schema_id], record.metadata
                        channels[record.id] = writer.register_channel(*own)
                        stepping |= {record.id} if record.topic.endswith("/rl/step") else set()
                case Message():
                    where = channels[record.channel_id], record.log_time, record.data, record.publish_time
                    writer.add_message(*where, record.sequence)
                    count, steps = count + 1, steps + (record.channel_id in stepping)
                    size += len(record.data)
                    if size > CHUNK and steps:  # what stands before the first step is one chunk
                        writer.flush()
                        size = 0
                case Attachment():
                    times = record.create_time, record.log_time
                    writer.add_attachment(*times, record.name, record.media_type, record.data)
                case Metadata():
                    writer.add_metadata(record.name, with_checksum(record.name, record.metadata))
        writer.finish()
    return count, steps
