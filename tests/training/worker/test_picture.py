"""Pictures: the robot is in them, upright, and where it moves; films hold the frames that they should."""

from __future__ import annotations

import io

import numpy as np
import pytest
import torch
from PIL import Image

from worker.settings.cartpole import CartpoleConfig
from worker.tasks.library.cartpole import Cartpole
from worker.telemetry.picture import EpisodePicture, StageCamera, encode, pace
from worker.telemetry.stage import Stage

torch.set_num_threads(1)
CONFIG = CartpoleConfig(episode_seconds=0.2)


@pytest.fixture(scope="module")
def camera() -> StageCamera:
    return StageCamera(Stage(Cartpole, CONFIG, 2), 160, 60)


def orange(image: np.ndarray) -> np.ndarray:
    """Where the pole is, [0.9, 0.6, 0.2] in the robot's file."""
    red, green, blue = np.moveaxis(image.astype(int), -1, 0)
    return (red > 120) & (red > green + 15) & (green > blue + 40)


def blue(image: np.ndarray) -> np.ndarray:
    """Where the cart is, [0.2, 0.4, 0.8]."""
    red, green, other = np.moveaxis(image.astype(int), -1, 0)
    return (other > green + 40) & (green > red + 15)


def test_each_world_is_in_its_tile_upright_and_leaning_as_it_leans(camera: StageCamera) -> None:
    picture = camera.take(np.array([[0.0, 0.0], [0.0, 0.9]], np.float32))
    assert picture.shape == (60, 160, 3)
    for tile, leans in ((picture[:, :80], False), (picture[:, 80:], True)):
        pole, cart = np.argwhere(orange(tile)), np.argwhere(blue(tile))
        assert len(pole) > 30 and len(cart) > 30
        assert pole[:, 0].mean() < cart[:, 0].mean(), "the pole is above the cart"
        width, height = np.ptp(pole[:, 1]), np.ptp(pole[:, 0])
        assert (width > height / 2) == leans


def test_the_camera_follows_the_robot(camera: StageCamera) -> None:
    camera.take(np.zeros((2, 2), np.float32))
    far = camera.take(np.array([[1.5, 0.0], [-1.5, 0.0]], np.float32))
    for tile in (far[:, :80], far[:, 80:]):
        assert 25 < np.argwhere(blue(tile))[:, 1].mean() < 55


@pytest.mark.parametrize(
    ("ending", "hertz", "stride", "rate"),
    [(".gif", 60, 3, 20.0), (".gif", 50, 2, 25.0), (".mp4", 50, 2, 25.0), (".mp4", 60, 2, 30.0), (".mp4", 20, 1, 20.0)],
)
def test_a_film_runs_as_fast_as_the_simulated_time(ending: str, hertz: float, stride: int, rate: float) -> None:
    assert pace(hertz, ending) == (stride, rate)
    shades = [np.full((64, 96, 3), 20 * number, np.uint8) for number in range(8)]
    film = io.BytesIO(encode(shades, ending, rate))
    if ending == ".gif":
        image = Image.open(film)
        assert (image.n_frames, image.size, image.info["duration"]) == (8, (96, 64), round(1000 / rate))
        return
    import av

    with av.open(film) as container:
        stream = container.streams.video[0]
        assert stream.codec_context.name == "h264" and stream.average_rate == rate
        frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(stream)]
    assert [frame.shape for frame in frames] == [(64, 96, 3)] * 8
    np.testing.assert_allclose([frame.mean() for frame in frames], [20 * number for number in range(8)], atol=6)


def test_a_glance_shows_the_first_episode_of_an_evaluation_and_is_gone_after_it() -> None:
    task = Cartpole(CONFIG, 3, seed=2)
    preview = EpisodePicture(task)
    task.reset()
    for _ in range(12):
        task.step(torch.ones(3, 1))
    image = np.asarray(Image.open(io.BytesIO(preview.picture(CONFIG, width=80, height=60))))
    assert image.shape == (122, 244, 3)
    tiles = [image[row : row + 60, column : column + 80] for row in (0, 62) for column in (0, 82, 164)]
    assert all(orange(tile).sum() > 30 and blue(tile).sum() > 30 for tile in tiles)
    before = task.state_dict()
    twin = Cartpole(CONFIG, 3, seed=2)
    twin.reset()
    for _ in range(12):
        twin.step(torch.ones(3, 1))
    assert all(torch.equal(before[name], tensor) for name, tensor in twin.state_dict().items())
