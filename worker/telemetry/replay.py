"""The replay of a recording in the live view: whole, or as much as there is of one that was cut short."""

from __future__ import annotations

import io
import re
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from worker.settings.errors import UserError
from worker.telemetry import messages
from worker.telemetry.intact_records import SoundRecords
from worker.telemetry.recording import PARTIAL
from worker.telemetry.screen import Appearance, ShownSteps

BATCH = 256
"""Control steps that are handed out together."""
_IMAGES = re.compile(r"/world_(\d+)/(.+)/image/compressed")
"""World and camera."""


class Replay:
    """A recording of Muster's, from its beginning.

    Args:
        path: ``.mcap``, or ``.mcap.partial`` of one that was cut short.

    Attributes:
        look: What is seen.
        cut: Whether the file ends before its end; known once all :meth:`parts` were read.
        losses: What a damaged file has lost, in words; known then, too.
        count: Control steps that were read.

    Raises:
        UserError: It is not such a file.
    """

    def __init__(self, path: Path) -> None:
        self.path, self.cut, self.losses, self.count = path, False, "", 0
        if not path.is_file():
            raise UserError(f"{path}: there is no such file")
        shapes: dict[str, bytes] = {}
        places: list[tuple[float, float, float]] = []
        links: list[str] = []
        cameras: list[str] = []
        terms: tuple[str, ...] | None = None
        steps = False
        with self._own_messages():
            for kind, topic, _, data in self._messages():
                if topic == "/tf" and terms is not None:
                    break  # the first step is over
                if topic == "/tf_static":
                    for each in _decoded(kind, data).transforms:
                        where = each.transform.translation
                        places.append((where.x, where.y, where.z))
                elif topic in ("/ground", "/world_0/scene"):
                    for entity in _decoded(kind, data).entities:
                        frame = "ground" if topic == "/ground" else entity.frame_id.removeprefix("world_0").lstrip("/")
                        shapes[frame] = bytes(entity.models[0].data)
                elif topic == "/tf":
                    links = [each.child_frame_id for each in _decoded(kind, data).transforms]
                elif topic == "/world_0/rl/step":
                    steps = True
                    terms = tuple(_decoded(kind, data).reward_names) if shapes and places else None
                elif found := _IMAGES.fullmatch(topic):
                    cameras += [found[2]] if found[1] == "0" else []
        if terms is not None:
            own = tuple(link.removeprefix("world_0/") for link in links if link.startswith("world_0/"))
            self.look = Appearance(own, shapes, np.array(places), terms, tuple(cameras))
            self.cut = False
            return
        if steps:
            raise UserError(
                f"{path}: what its worlds look like (/world_0/scene, /tf_static) is lost, so that it can't be drawn; "
                f"`rerun {path.name}` and ROS 2's tools show the rest"
            )
        what = "it ends before the first control step" if self.cut else "it has no control steps of Muster's recordings"
        raise UserError(f"{path}: {what}; `rerun {path.name}` shows what else is in it")

    def parts(self) -> Iterator[ShownSteps]:
        """All control steps, in order."""
        found = _Gathered(self.look)
        with self._own_messages():
            for kind, topic, time, data in self._messages():
                if topic == "/tf":
                    if len(found.times) == BATCH:
                        yield found.part(self.count + 1)
                        self.count += BATCH
                        found = _Gathered(self.look, found.sums)
                    found.move(time, _decoded(kind, data).transforms)
                elif topic == "/rosout":
                    line = _decoded(kind, data)
                    found.log.append((time, line.name, line.msg))
                elif topic.endswith("/rl/step") and found.times:
                    found.step(time, _decoded(kind, data))
                elif (camera := _IMAGES.fullmatch(topic)) and found.times:
                    found.images[camera[2]][len(found.times) - 1].append(bytes(_decoded(kind, data).data))
        if found.times:
            yield found.part(self.count + 1)
            self.count += len(found.times)

    @contextmanager
    def _own_messages(self) -> Iterator[None]:
        """A context that reads Muster's messages. Raises UserError for messages of another form."""
        try:
            yield
        except UserError:
            raise
        except Exception as error:  # rosbags raises whatever its generated code meets in the bytes of another program
            raise UserError(
                f"{self.path}: it is not a recording of Muster's: its topics have other messages; `rerun {self.path.name}` may show it"
            ) from error

    def _messages(self) -> Iterator[tuple[str, str, int, bytes]]:
        """Type, topic, time [ns] and content, as they were written. Sets :attr:`cut`. Raises UserError where it is not an MCAP file."""
        from mcap.records import Channel, Message, Schema

        kinds: dict[int, str] = {}
        channels: dict[int, tuple[str, str]] = {}
        records = SoundRecords(self.path)
        self.cut = True
        try:
            for record in records:
                if isinstance(record, Schema):
                    kinds[record.id] = record.name
                elif isinstance(record, Channel):
                    channels[record.id] = kinds.get(record.schema_id, ""), record.topic
                elif isinstance(record, Message):
                    yield *channels[record.channel_id], record.log_time, record.data
        except OSError as error:
            raise UserError(f"{self.path}: it can't be read ({error.strerror or error})") from error
        self.cut, self.losses = not records.whole and not records.damaged, records.losses()
        if not records.found:
            raise UserError(
                f"{self.path}: it does not begin as an MCAP file does; give an .mcap, .mcap{PARTIAL} or .rrd file"
            )


@dataclass
class _Gathered:
    """Control steps that are being read."""

    look: Appearance
    sums: defaultdict[int, float] = field(default_factory=lambda: defaultdict(float))
    """Return of each world's running episode."""
    times: list[int] = field(default_factory=list)
    poses: list[np.ndarray] = field(default_factory=list)
    rewards: list[list[np.ndarray]] = field(default_factory=list)
    log: list[tuple[int, str, str]] = field(default_factory=list)
    returns: list[tuple[int, float]] = field(default_factory=list)
    images: defaultdict[str, defaultdict[int, list[bytes]]] = field(
        default_factory=lambda: defaultdict(lambda: defaultdict(list))
    )

    def part(self, first: int) -> ShownSteps:
        """The steps, numbered from ``first``; those without an image of every world have none."""
        rewards = [np.mean(each, 0) if each else np.zeros(len(self.look.terms)) for each in self.rewards]
        worlds, count = len(self.look.places), len(self.times)
        images = {
            camera: {
                step: np.stack([np.asarray(Image.open(io.BytesIO(each))) for each in files])
                for step, files in steps.items()
                if len(files) == worlds
            }
            for camera, steps in self.images.items()
        }
        arrays = np.array(self.times), np.arange(first, first + count), np.array(self.poses), np.array(rewards)
        return ShownSteps(*arrays, images=images, log=self.log, returns=self.returns)

    def move(self, time: int, transforms: list[Any]) -> None:
        parts = [(each.transform.translation, each.transform.rotation) for each in transforms]
        poses = np.array([(at.x, at.y, at.z, turn.x, turn.y, turn.z, turn.w) for at, turn in parts])
        self.times.append(time)
        self.poses.append(poses.reshape(len(self.look.places), len(self.look.links), 7))
        self.rewards.append([])

    def step(self, time: int, step: Any) -> None:
        self.rewards[-1].append(np.asarray(step.reward_terms))
        self.sums[step.world] += step.reward
        if step.done:
            self.returns.append((time, self.sums.pop(step.world)))


def _decoded(kind: str, data: bytes) -> Any:
    return messages.types().deserialize_cdr(data, kind)
