"""A camera in every world: what it sees by hand, stacks, differing scenes, learning from bytes, export."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch

from shared_store.volume.checkpoints import list_checkpoints
from shared_store.volume.layout import Store
from tests.support.refusals import refusal
from tests.support.worker.ranks import training
from tests.support.worker.runs import assert_same_bits, last, train
from tests.support.worker.tasks import put
from worker.export import export
from worker.learning.job import configure
from worker.learning.loop import Loop
from worker.settings.errors import UserError
from worker.tasks.library.cartpole_pixels import CartpolePixels, CartpolePixelsConfig

torch.set_num_threads(1)
SKY = torch.tensor([0x90, 0xB0, 0xD0], dtype=torch.uint8)


@pytest.fixture(scope="module")
def pixels() -> CartpolePixels:
    return CartpolePixels(CartpolePixelsConfig(), 4, seed=1)


def cart_column(image: torch.Tensor) -> float:
    """Mean column of the cart, the only thing that is bluer than the sky is; ``image`` is (3, height, width)."""
    red, _, blue = image.float()
    return (blue > 3 * red).nonzero()[:, 1].float().mean().item()


def test_the_image_shows_the_cart_where_a_pinhole_puts_it(pixels: CartpolePixels) -> None:
    assert pixels.observation_shape == (6, 64, 64) and pixels.observations.dtype == torch.uint8
    places = [-1.2, -0.4, 0.4, 1.2]
    put(pixels, joint_q=[[place, 0.0] for place in places], joint_qd=[[0.0, 0.0]] * 4)
    pixels.step(torch.zeros(4, 1))
    assert torch.equal(pixels.observations[0, :3, 0, 0], SKY)
    camera = pixels.config.camera
    half_width = abs(camera.position[1]) * math.tan(camera.fov / 2)
    for world, place in enumerate(places):
        expected = 32.0 + 32.0 * place / half_width - 0.5
        # the face of the cart that is seen is 0.12 m nearer than its middle
        assert cart_column(pixels.observations[world, :3]) == pytest.approx(expected, abs=1.5)


@pytest.mark.parametrize(
    ("config", "message"),
    [
        ({"camera": {"samples": 0}}, "camera.samples: expected a value greater than or equal to 1, found 0"),
        ({"camera": {"position": [0.0, 1.0]}}, "camera.position: expected [x, y, z], found [0.0, 1.0]"),
        ({"camera": {"target": [0.0, math.nan, 1.0]}}, "camera.target: expected [x, y, z], found [0.0, nan, 1.0]"),
        ({"randomize": {"light": [1.0]}}, "randomize.light: expected [least, greatest]"),
        ({"randomize": {"colors": -1.0}}, "randomize.colors: expected a value greater than or equal to 0, found -1.0"),
    ],
)
def test_a_camera_that_cannot_be_is_refused_in_one_line(config: dict, message: str) -> None:
    assert f"train.config.{message}" in refusal(configure, CartpolePixels, {"config": config}, error=UserError)


def run(path: Path, name: str, iterations: int, epoch: int = 1) -> Loop:
    env = training(path, run=name, iterations=iterations, epoch=epoch, worlds=4, task="CartpolePixels")
    return train(env, task=CartpolePixels)


def test_a_run_resumes_with_the_same_bits_and_its_policy_can_be_exported(tmp_path: Path) -> None:
    straight = run(tmp_path, "straight", 3)
    assert straight.algorithm.rollout.actor.observations.dtype == torch.uint8, "the rollout holds bytes"
    gradients = [p.grad for p in straight.algorithm.actor.cnns.parameters()]
    assert all(g is not None and g.abs().max() > 0 for g in gradients), "the convolutions learn"
    run(tmp_path, "stopped", 2)
    run(tmp_path, "stopped", 3, epoch=2)
    assert_same_bits(last(tmp_path, "straight"), last(tmp_path, "stopped"))
    store = Store(tmp_path).run("straight")
    target = export(store, list_checkpoints(store)[-1], straight.task)  # compares the files with the policy itself
    import onnx

    graph = onnx.load(str(target / "policy.onnx")).graph
    kind = graph.input[0].type.tensor_type
    assert kind.elem_type == onnx.TensorProto.UINT8
    assert [axis.dim_value for axis in kind.shape.dim][1:] == [6, 64, 64]
