"""A recording: what the tap saw of some worlds as an MCAP file that ROS 2's tools, Foxglove, Lichtblick, PlotJuggler and Rerun open.

Frames are ``world`` with one ``world_<k>`` for each recorded world, apart from each other, and in it ``world_<k>/<link>``. Times are
simulated ones, counted from the time of day at which the recording began.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import IO, TYPE_CHECKING, Any, NamedTuple

import numpy as np

from worker.settings.errors import UserError
from worker.telemetry import messages
from worker.telemetry.intact_records import CHANNELS, LIBRARY, SoundRecords, with_checksum
from worker.telemetry.rows import Rows

if TYPE_CHECKING:
    from mcap.writer import Writer

    from worker.telemetry.stage import Stage


CHUNK = 256 << 10
"""Bytes of messages after which a chunk is closed and compressed."""
_FAR = 1 << 20
"""Bytes of a chunk from which on equal parts are looked for all over it."""
_FLUSH_SECONDS = 1.0
"""Between two chunks that are closed for the sake of what a kill would lose [s]."""
PARTIAL = ".partial"
"""Behind the name of a file that is being written."""
_FOR_EVER = {"sec": 9223372036, "nsec": 854775807}
_LATCHED = {
    **dict.fromkeys(("history", "depth", "reliability", "durability", "liveliness"), 1),
    **dict.fromkeys(("deadline", "lifespan", "liveliness_lease_duration"), _FOR_EVER),
    "avoid_ros_namespace_conventions": False,
}
"""The quality of service, in ROS 2's numbers, of messages written once: players keep them for late subscribers."""


def writer_to(file: IO[bytes]) -> Writer:
    """A writer of chunks that its caller ends with ``flush``. What stands in a chunk several times, such as each world's copy of the
    robot's meshes, takes space once.
    """
    from mcap import writer

    def compress(data: bytes) -> bytes:
        if len(data) < _FAR:
            return zstandard.compress(data)
        # by itself zstd looks back 2 MiB; decoders take windows of up to 2^27 bytes
        options = zstandard.ZstdCompressionParameters.from_level(3, window_log=27, enable_ldm=True)
        return zstandard.ZstdCompressor(compression_params=options).compress(data)

    import zstandard

    setattr(writer, "zstandard", SimpleNamespace(compress=compress))  # noqa: B010 (mcap has no parameter for it)
    return writer.Writer(file, chunk_size=1 << 40, enable_data_crcs=True)


class Recording:
    """An MCAP file that is being written: as ``<path>.partial``, which gets its name when it is whole.

    Args:
        path: The file.
        stage: What the worlds look like; it has as many as are recorded.
        facts: Of the run, for the metadata of each episode: ``run``, ``checkpoint``, ….
        attachments: Further files, by name: the policy's contract, the job.

    Raises:
        UserError: The file can't be written.
    """

    def __init__(self, path: Path, stage: Stage, facts: Mapping[str, str], attachments: Mapping[str, bytes]) -> None:
        self.path, self._stage, self._facts = path, stage, dict(facts)
        self.partial = path.with_name(path.name + PARTIAL)
        self._start = time.time_ns()
        self._rate = 1.0
        self._channels: dict[str, int] = {}
        self._table: list[dict[str, Any]] = []
        self._size = 0
        """Bytes of messages in the running chunk."""
        self._repeated = 0
        """How many channels of the table the file repeats in an attachment."""
        self._schemas: dict[str, int] = {}
        self._sums = np.zeros((stage.worlds, 2))
        """Return and steps of each running episode."""
        self.steps = self.episodes = self.lost = 0
        self._ended = np.zeros(stage.worlds, np.int64)
        self._whole = np.zeros(stage.worlds, bool)
        """Whether each running episode was recorded from its first step on, without a gap."""
        self._just_ended = np.zeros(stage.worlds, bool)
        try:
            self._file = self.partial.open("wb")
            self._writer = writer_to(self._file)
            self._writer.start("ros2", LIBRARY)
            self._attach(attachments)
            self._write_scene()
            self._flush()
        except OSError as error:
            raise self._full(error) from error

    def write(self, rows: Rows) -> None:
        """Add the next control steps. Raises UserError where there is no space left, or the volume is gone."""
        try:
            self.lost += rows.lost
            if rows.lost:
                self._whole[:] = self._just_ended[:] = False
            for step in range(len(rows)):
                self._write_step(rows, step)
                if self._size > CHUNK or time.monotonic() - self._flushed > _FLUSH_SECONDS:
                    self._flush()
        except OSError as error:
            raise self._full(error) from error

    def complete(self, episodes: int) -> bool:
        """Whether each world has ended so many episodes."""
        return self.ended(episodes) == episodes * self._stage.worlds

    def ended(self, episodes: int) -> int:
        """Number of episodes that have ended, at most ``episodes`` for each world."""
        return int(np.minimum(self._ended, episodes).sum())

    def interrupt(self, text: str) -> None:
        """The worlds begin anew, as after a crash: the episodes that were running have no end. ``text`` is for the log."""
        self._sums[:] = 0.0
        self._whole[:] = self._just_ended[:] = False
        self.log(text, level=30)

    def log(self, text: str, level: int = 20, name: str = "muster") -> None:
        """Add a line of the job's log, at the time of the newest step."""
        now = self._now()
        self._add("/rosout", "rcl_interfaces/msg/Log", now, messages.log(now, level, name, text))

    def finish(self) -> Path:
        """Complete the file and give it its name; returns the path. Raises UserError as :meth:`write`."""
        try:
            self._writer.finish()
            self._file.flush()
            os.fsync(self._file.fileno())
            self._file.close()
            os.replace(self.partial, self.path)
        except OSError as error:
            raise self._full(error) from error
        return self.path

    def _now(self) -> int:
        return self._start + round(self.steps * 1e9 / self._rate)

    def _attach(self, attachments: Mapping[str, bytes]) -> None:
        for name, data in attachments.items():
            media = {".json": "application/json", ".xml": "application/xml", ".urdf": "application/xml"}
            kind = media.get(Path(name).suffix, "application/octet-stream")
            self._writer.add_attachment(self._start, self._start, name, kind, data)

    def _write_scene(self) -> None:
        """The messages at the beginning: the places of the worlds and the shapes of the links.

        A robot from URDF is described by its file. No ROS tool reads MJCF: such a file is attached, and the links have their shapes.
        """
        now, places = self._start, self._stage.places().tolist()
        names = [f"world_{world}" for world in range(self._stage.worlds)]
        frames = [("world", name, [*place, 0.0, 0.0, 0.0, 1.0]) for name, place in zip(names, places, strict=True)]
        self._add("/tf_static", "tf2_msgs/msg/TFMessage", now, messages.transforms(now, frames))
        if self._stage.robot_file:
            name, text = self._stage.robot_file
            self._attach({name: text.encode()})
            if name.endswith(".urdf"):
                kind = "std_msgs/msg/String"
                self._add("/robot_description", kind, now, messages.encoded(kind, data=text))
        meshes = self._stage.meshes()
        if ground := meshes.pop("ground", None):
            self._add("/ground", messages.SCENE, now, messages.scene(now, {"world": ground}))
        for name in names:
            models = {f"{name}/{link}" if link else name: data for link, data in meshes.items()}
            self._add(f"/{name}/scene", messages.SCENE, now, messages.scene(now, models))

    def _write_step(self, rows: Rows, step: int) -> None:
        stage, layout = self._stage, rows.layout
        self._rate, self.steps = layout.control_hz, rows.first + step + 1
        now = self._now()
        frames = [
            (f"world_{world}", f"world_{world}/{link}", pose)
            for world, poses in enumerate(stage.pose(rows.coordinates[step]))
            for link, pose in zip(stage.links, poses.tolist(), strict=True)
        ]
        self._add("/tf", "tf2_msgs/msg/TFMessage", now, messages.transforms(now, frames))
        for world in range(stage.worlds):
            frame = f"world_{world}"
            if stage.joints:
                positions = rows.coordinates[step, world, stage.coordinates]
                velocities = rows.velocities[step, world, stage.dofs]
                data = messages.joint_states(now, frame, stage.joints, positions, velocities)
                self._add(f"/{frame}/joint_states", "sensor_msgs/msg/JointState", now, data)
            self._write_world(rows, step, world, now)
        for camera, images in rows.pictures(step).items():
            for world, image in enumerate(images):
                data = messages.compressed_image(now, f"world_{world}", image)
                self._add(f"/world_{world}/{camera}/image/compressed", "sensor_msgs/msg/CompressedImage", now, data)

    def _write_world(self, rows: Rows, step: int, world: int, now: int) -> None:
        layout, frame = rows.layout, f"world_{world}"
        done = bool(rows.mark("done")[step, world])
        fields = {
            "header": messages.header(now, frame),
            "world": world,
            "episode": int(rows.mark("episode")[step, world]),
            "age": int(rows.mark("age")[step, world]),
            "done": done,
            "time_out": bool(rows.mark("time_out")[step, world]),
            "reward": float(rows.rewards[step, world]),
            "reward_names": list(layout.terms),
            "reward_terms": rows.terms[step, world],
            "action_names": list(layout.actions),
            "action": rows.actions[step, world],
            "observation_names": list(layout.observations),
            "observation": rows.observations[step, world],
        }
        self._add(f"/{frame}/rl/step", messages.STEP, now, messages.encoded(messages.STEP, **fields))
        if not self._sums[world, 1]:
            # if the first step seen ends an episode, the episode's beginning is unknown
            self._whole[world] = self._just_ended[world] or (fields["age"] == 1 and not done)
        self._just_ended[world] = done
        self._sums[world] += fields["reward"], 1
        if done:
            self._end_episode(rows, step, world, fields["episode"])

    def _end_episode(self, rows: Rows, step: int, world: int, number: int) -> None:
        total, steps = self._sums[world]
        self._sums[world] = 0.0
        self.episodes += 1
        self._ended[world] += 1
        facts = {
            **self._facts,
            "world": str(world),
            "episode": str(number),
            "return": f"{total:.6g}",
            "length": str(int(steps)),
            "end": rows.cause(step, world),
            "complete": "true" if self._whole[world] else "false",
        }
        self._writer.add_metadata("episode", with_checksum("episode", facts))
        self.log(rows.end_of_episode(step, world, number, total, int(steps)))

    def _add(self, topic: str, kind: str, now: int, data: bytes) -> None:
        if topic not in self._channels:
            if kind not in self._schemas:
                text = messages.definition(kind).encode()
                self._schemas[kind] = self._writer.register_schema(kind, "ros2msg", text)
            latched = topic in ("/tf_static", "/robot_description", "/ground") or topic.endswith("/scene")
            quality = {"offered_qos_profiles": json.dumps([_LATCHED])} if latched else {}
            schema = self._schemas[kind]
            number = self._channels[topic] = self._writer.register_channel(topic, "cdr", schema, quality)
            self._table.append({"id": number, "topic": topic, "schema_id": schema, "type": kind, "metadata": quality})
        self._writer.add_message(self._channels[topic], now, data, now)
        self._size += len(data)

    def _flush(self) -> None:
        self._writer.flush()
        self._size = 0
        if self._repeated < len(self._table):
            self._repeated = len(self._table)
            self._attach({CHANNELS: json.dumps(self._table).encode()})
        self._file.flush()
        self._flushed = time.monotonic()

    def _full(self, error: OSError) -> UserError:
        return UserError(
            f"{self.partial}: it can't be written ({error.strerror or error}); what is there is kept: free space, then "
            f"muster record --recover {self.partial}"
        )


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
