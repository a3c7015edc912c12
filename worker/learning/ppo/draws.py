"""Random draws of PPO on the device: actions, and the samples of each minibatch.

Every number is a function of (seed, iteration, global index of the world) and its purpose. So neither the number of ranks nor a restart
changes it, and no rank draws for other ranks' worlds.
"""

from __future__ import annotations

import torch
import warp as wp

from worker.learning.parts import launch
from worker.learning.randomness import mix_seed

_ACTIONS, _ORDER = 0, 1
wp.set_module_options({"enable_backward": False})


@wp.func
def _stream(key: wp.array[wp.int32], what: int, world: int, number: int) -> wp.uint32:
    """A separate generator for each (iteration, purpose, world, number)."""
    return wp.rand_init(int(wp.rand_init(key[what], world)), number)


@wp.kernel
def _draw_normal(
    key: wp.array[wp.int32],
    step: int,
    first: int,
    mean: wp.array2d[wp.float32],
    std: wp.array[wp.float32],
    actions: wp.array2d[wp.float32],
):
    world, column = wp.tid()
    stream = _stream(key, 0, first + world, step * mean.shape[1] + column)
    actions[world, column] = mean[world, column] + std[column] * wp.randn(stream)


@wp.kernel
def _draw_choices(
    key: wp.array[wp.int32],
    step: int,
    first: int,
    logits: wp.array2d[wp.float32],
    actions: wp.array2d[wp.float32],
):
    """The greatest of logits + Gumbel noise is a draw from their softmax (Gumbel 1954; Maddison et al., arXiv:1411.0030)."""
    world = wp.tid()
    stream = _stream(key, 0, first + world, step)
    best = float(-1.0e38)
    choice = int(0)  # noqa: RUF046
    for column in range(logits.shape[1]):
        uniform = wp.max(wp.randf(stream), 1.0e-9)
        score = logits[world, column] - wp.log(-wp.log(uniform))
        if score > best:
            best = score
            choice = column
    actions[world, 0] = float(choice)


@wp.kernel
def _draw_order(
    key: wp.array[wp.int32],
    first: int,
    worlds: int,
    minibatches: int,
    scratch: wp.array3d[wp.int32],
    orders: wp.array3d[wp.int64],
):
    """Shuffle the steps of one world in one epoch (Fisher and Yates) and deal them out to the minibatches."""
    epoch, world = wp.tid()
    steps = scratch.shape[2]
    stream = _stream(key, 1, first + world, epoch)
    for step in range(steps):
        scratch[epoch, world, step] = step
    for step in range(steps - 1):
        other = step + int(wp.randf(stream) * float(steps - step))
        other = wp.min(other, steps - 1)
        kept = scratch[epoch, world, step]
        scratch[epoch, world, step] = scratch[epoch, world, other]
        scratch[epoch, world, other] = kept
    share = orders.shape[1]
    for minibatch in range(minibatches):
        for place in range(share):
            step = scratch[epoch, world, minibatch * share + place]
            orders[epoch * minibatches + minibatch, place, world] = wp.int64(step) * wp.int64(worlds) + wp.int64(world)


class Draws:
    """The draws of one rank. The kernels read what :meth:`begin` sets from the device, so they can be part of a graph.

    Args:
        seed: Seed of all draws.
        first: Global index of the rank's first world.
        device: ``"cpu"`` or ``"cuda:<n>"``.
    """

    def __init__(self, seed: int, first: int, device: str) -> None:
        wp.init()
        self._seed, self._first, self._device = seed, first, device
        self._key = torch.zeros(2, dtype=torch.int32, device=device)
        self._host = torch.zeros(2, dtype=torch.int32, pin_memory=device.startswith("cuda"))

    def begin(self, iteration: int) -> None:
        """Set the iteration of all further draws."""
        for purpose in (_ACTIONS, _ORDER):
            self._host[purpose] = mix_seed(self._seed, iteration, purpose) & 0x7FFFFFFF
        self._key.copy_(self._host, non_blocking=True)

    def normal(self, step: int, mean: torch.Tensor, std: torch.Tensor, out: torch.Tensor) -> torch.Tensor:
        """Fill ``out`` with ``mean`` + ``std`` · normal noise, shapes (worlds, actions), (actions,), (worlds, actions)."""
        launch(_draw_normal, mean.shape, (self._key, step, self._first, mean, std, out), self._device)
        return out

    def choices(self, step: int, logits: torch.Tensor, out: torch.Tensor) -> torch.Tensor:
        """Fill ``out``, shape (worlds, 1), with choices drawn by their ``logits``, shape (worlds, choices)."""
        launch(_draw_choices, len(logits), (self._key, step, self._first, logits, out), self._device)
        return out

    def order(self, orders: torch.Tensor, scratch: torch.Tensor) -> None:
        """Distribute every world's steps over the minibatches, again in each epoch. Each minibatch has equally many steps of each world.

        Args:
            orders: Filled with rows of the flattened rollout (step · worlds + world); shape (epochs · minibatches, steps of a world in
                each minibatch, worlds), int64.
            scratch: Shape (epochs, worlds, steps), int32.
        """
        epochs, worlds, _ = scratch.shape
        numbers = self._first, worlds, len(orders) // epochs
        launch(_draw_order, (epochs, worlds), (self._key, *numbers, scratch, orders), self._device)
