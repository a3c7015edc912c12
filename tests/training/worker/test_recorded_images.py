"""Images of a training that runs: what a recording has of them is what its worlds' cameras saw, byte for byte. The live view: test_view.py."""

from __future__ import annotations

import io
import json
import threading
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
import torch
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from PIL import Image

from shared_store.volume.files import write_json
from shared_store.volume.layout import Run
from worker.learning.reporter import Gate
from worker.settings.overrides import configured
from worker.tasks.library.cartpole_pixels import CartpolePixels
from worker.telemetry.live_recording import record
from worker.telemetry.rows import Layout
from worker.telemetry.tap import LiveTap, Tap, TapReader

torch.set_num_threads(1)
CONFIG = {"episode_seconds": 0.2, "camera": {"width": 12, "height": 8}}
"""Episodes of 12 steps; two images of 12 x 8 in colour."""


@pytest.fixture(scope="module")
def task() -> CartpolePixels:
    return CartpolePixels(configured(CartpolePixels.config_type, CONFIG), 3, seed=3)


class Running:
    """Worlds that step in a thread as a training does, and answer who asks; the action of each step is its number."""

    def __init__(self, task: CartpolePixels, run: Run) -> None:
        write_json(run.path / "run.json", {"spec": {"train": {"task": "CartpolePixels", "config": CONFIG}}})
        self.run, self._task = run, task
        self.seen: list[np.ndarray] = []
        """Of each step the images of all worlds."""
        self._tap = LiveTap()
        self._tap.serve(run, task, Gate())
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._work)
        self._thread.start()

    def _work(self) -> None:
        while not self._over.wait(0.002):
            self._tap.before_iteration()
            self._task.step(torch.full((3, 1), float(len(self.seen))))
            self.seen.append(self._task.observations.numpy().copy())

    def newest(self, step: int, world: int) -> np.ndarray:
        """The present frame of a world after a step: the first three of its channels."""
        return self.seen[step][world, :3].transpose(1, 2, 0)

    def close(self) -> None:
        self._over.set()
        self._thread.join()
        self._tap.close()
        self._task.watch(None)


@pytest.fixture
def running(task: CartpolePixels, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Running]:
    monkeypatch.setattr("worker.telemetry.tap.POLL_SECONDS", 0.05)
    running = Running(task, Run(tmp_path / "run"))
    yield running
    running.close()


def test_a_recorded_training_has_the_images_of_each_step(running: Running, tmp_path: Path) -> None:
    made = record(running.run, "job", 2, 2, tmp_path / "pixels.mcap", 60.0)
    found: dict[str, list[np.ndarray]] = {"0": [], "1": []}
    steps: list[int] = []
    with made.path.open("rb") as file:
        for each in make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages():
            _, world, *rest = (each.channel.topic + "///").split("/")[:4]
            if rest[0] == "policy":
                picture = Image.open(io.BytesIO(bytes(each.decoded_message.data)))
                found[world.removeprefix("world_")].append(np.asarray(picture))
            elif (world, *rest) == ("world_0", "rl", "step"):
                steps.append(int(each.decoded_message.action[0]))
    assert len(steps) >= 12 and steps == sorted(set(steps))  # poles may fall before the clock ends an episode
    for world, images in found.items():
        assert len(images) == len(steps)
        for step, image in zip(steps, images, strict=True):
            np.testing.assert_array_equal(image, running.newest(step, int(world)))
    assert len({image.tobytes() for image in found["0"]}) > 5, "the camera sees the cart move"


def test_images_that_are_too_large_are_left_out_and_one_line_says_so(
    task: CartpolePixels, monkeypatch: pytest.MonkeyPatch
) -> None:
    step = 2 * 3 * 12 * 8
    monkeypatch.setattr("worker.telemetry.tap.IMAGE_MEMORY", 40 * step)
    tap = Tap.within(task, 2)
    assert (tap.layout.rows, tap.layout.images, tap.left_out) == (40, (("policy", 3, 8, 12),), "")
    assert Layout.from_json(json.loads(json.dumps(asdict(tap.layout)))) == tap.layout
    monkeypatch.setattr("worker.telemetry.tap.IMAGE_MEMORY", 31 * step)
    tap = Tap.within(task, 2)
    assert (tap.layout.rows, tap.layout.images) == (1024, ())
    assert tap.left_out.startswith("images are left out: of 2 worlds they take 0.0 MB in each control step")
    tap.open()
    reading = TapReader(tap)
    task.step(torch.zeros(3, 1))
    rows = reading.take()
    assert len(rows) == 1 and not rows.images.size and rows.pictures(0) == {}
    tap.close()
