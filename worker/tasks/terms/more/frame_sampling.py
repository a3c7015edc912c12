"""The sampling of start frames in a motion: episodes begin more often before parts in which robots fall."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import warp as wp

from worker.simulation.episodes import EpisodeArrays
from worker.tasks.terms.placing import between

wp.set_module_options({"enable_backward": False})

_SCALE = wp.constant(1.0e9)
"""Failures are summed as integer multiples of this fraction, so that the sum does not depend on the order."""
_UNIT = wp.constant(wp.vec2(0.0, 1.0))


@wp.struct
class SamplingArrays:
    """Failures of worlds in each part of a motion.

    Attributes:
        frames: Present frame of each world, shape ``(worlds,)``.
        failed: Part in which a world has just failed, else -1; shape ``(worlds,)``.
        failures: Failures of each world in each part, with less weight for older ones, shape ``(worlds, parts)``; without parts all
            frames are equally likely.
        likely: Probability that an episode begins in a part or an earlier one, shape ``(parts,)``.
        evenness: Entropy of these probabilities over that of equal ones, shape ``(1,)``.
    """

    frames: wp.array[wp.float32]
    failed: wp.array[wp.int32]
    failures: wp.array2d[wp.float32]
    likely: wp.array[wp.float32]
    evenness: wp.array[wp.float32]


@dataclass(frozen=True)
class AdaptiveSampling:
    """Begin episodes more often where they failed lately: the adaptive sampling of BeyondMimic (arXiv 2508.08241), as in mjlab.

    The motion is cut into parts. A part's probability is proportional to its failures plus ``even`` divided by the number of parts; each
    part then also counts those of the next ``reach - 1`` parts, each with ``decay`` times the weight of the one before. Failures are
    summed over all worlds of the gang: in each step, ``rate`` times the new failures plus ``1 - rate`` times the old ones. Those of other
    ranks are as they were when the training iteration began.

    Attributes:
        seconds: Length of a part [s].
        even: Additional failures, spread over all parts.
        rate: Weight of the newest step.
        reach: Number of parts up to a failure that become likelier, including the part of the failure.
        decay: Weight of each such part relative to the next.
    """

    seconds: float = 1.0
    even: float = 0.1
    rate: float = 0.001
    reach: int = 1
    decay: float = 0.8

    def check(self) -> None:
        """Raises ValueError where a number is out of its range."""
        ranges = (
            ("seconds", self.seconds > 0, "a number > 0"),
            ("even", self.even > 0, "a number > 0"),
            ("rate", 0 < self.rate <= 1, "a number > 0, at most 1"),
            ("reach", self.reach >= 1, "a whole number >= 1"),
            ("decay", 0 < self.decay <= 1, "a number > 0, at most 1"),
        )
        for name, fits, expected in ranges:
            if not fits:
                raise ValueError(f"AdaptiveSampling.{name} is {getattr(self, name)}; use {expected}")


@wp.func
def part_of(sampling: SamplingArrays, frame: float, frames: int) -> int:
    """The part of the motion in which a frame is."""
    parts = sampling.failures.shape[1]
    return wp.clamp(int(frame * float(parts) / float(frames)), 0, parts - 1)


@wp.func
def drawn_frame(
    episodes: EpisodeArrays, sampling: SamplingArrays, world: int, frames: int, stream: wp.uint32, last: int
) -> int:
    """Note where the episode before failed, if it did, and draw the frame with which the next one begins.

    Args:
        episodes: Of the task.
        sampling: Of the motion.
        world: Whose episode begins.
        frames: Of the motion.
        stream: Its numbers 0 and ``last`` are used.
        last: See ``stream``.
    """
    parts = sampling.failures.shape[1]
    if parts == 0:
        return wp.randi(wp.rand_init(int(stream), 0), 0, frames)
    if episodes.dones[world] and not episodes.time_outs[world]:
        sampling.failed[world] = part_of(sampling, sampling.frames[world], frames)
    chosen = between(stream, 0, _UNIT)
    part = int(0)  # noqa: RUF046 (a variable for Warp, not a constant)
    while part < parts - 1 and chosen >= sampling.likely[part]:
        part = part + 1
    within = between(stream, last, _UNIT)
    return wp.min(int((float(part) + within) / float(parts) * float(frames)), frames - 1)


@wp.kernel
def _count(rate: float, sampling: SamplingArrays, sums: wp.array[wp.int64]):
    """One part of one world: a step is over."""
    world, part = wp.tid()
    new = wp.where(sampling.failed[world] == part, rate, 0.0)
    failures = (1.0 - rate) * sampling.failures[world, part] + new
    sampling.failures[world, part] = failures
    wp.atomic_add(sums, part, wp.int64(failures * _SCALE))


@wp.kernel
def _share(even: float, reach: int, decay: float, sampling: SamplingArrays, sums: wp.array[wp.int64]):
    """Probabilities of all parts; one thread."""
    parts = sampling.likely.shape[0]
    total = float(0.0)
    for part in range(parts):
        weight = float(1.0)
        share = float(0.0)
        for ahead in range(reach):
            reached = wp.min(part + ahead, parts - 1)
            share = share + weight * (float(sums[reached]) / _SCALE + even / float(parts))
            weight = weight * decay
        total = total + share
        sampling.likely[part] = total
    before = float(0.0)
    entropy = float(0.0)
    for part in range(parts):
        up_to = sampling.likely[part] / total
        probability = up_to - before
        if probability > 0.0:
            entropy = entropy - probability * wp.log(probability)
        sampling.likely[part] = up_to
        before = up_to
    sampling.evenness[0] = wp.where(parts > 1, entropy / wp.log(float(parts)), 1.0)


class FrameSampling:
    """The sampling of a motion in some worlds.

    Args:
        declaration: The adaptive sampling; None: all frames are equally likely.
        seconds: Length of the motion [s].
        world_count: Number of worlds of this rank.
        device: Device of its arrays.
    """

    def __init__(self, declaration: AdaptiveSampling | None, seconds: float, world_count: int, device: str) -> None:
        if declaration is not None:
            declaration.check()
        self._declaration, self._worlds, self._device = declaration, world_count, device
        parts = int(seconds / declaration.seconds) + 1 if declaration else 0
        arrays = self.arrays = SamplingArrays()
        arrays.frames = wp.zeros(world_count, dtype=wp.float32, device=device)
        arrays.failed = wp.full(world_count, -1, dtype=wp.int32, device=device)
        arrays.failures = wp.zeros((world_count, parts), dtype=wp.float32, device=device)
        arrays.likely = wp.zeros(parts, dtype=wp.float32, device=device)
        arrays.evenness = wp.ones(1, dtype=wp.float32, device=device)
        self._sums = wp.zeros(parts, dtype=wp.int64, device=device)
        self._others = wp.zeros(parts, dtype=wp.int64, device=device)
        self._share()

    def advance(self) -> None:
        """Count the failures of the previous step, before the draws of this one. Launches only."""
        if self._declaration is None:
            return
        wp.copy(self._sums, self._others)
        self._launch(_count, self.arrays.failures.shape, self._declaration.rate)
        self.arrays.failed.fill_(-1)
        self._share()

    def state_tensors(self) -> dict[str, torch.Tensor]:
        """Live views of the state that the next step reads."""
        if self._declaration is None:
            return {}
        return {name: wp.to_torch(getattr(self.arrays, name)) for name in ("frames", "failed", "failures")}

    @property
    def is_adaptive(self) -> bool:
        """Whether failures count; else all frames are equally likely."""
        return self._declaration is not None

    def own_failures(self) -> torch.Tensor:
        """The failures in each part, of the worlds of this rank, as integer multiples of 1e-9; shape ``(parts,)``, int64."""
        failures: torch.Tensor = wp.to_torch(self.arrays.failures)
        return (failures * float(_SCALE)).to(torch.int64).sum(0)

    def take_failures(self, others: torch.Tensor) -> None:
        """From now on, count these failures of the worlds of other ranks too; as :meth:`own_failures` returns them."""
        wp.to_torch(self._others).copy_(others)

    def _share(self) -> None:
        if self._declaration is not None:
            self._launch(_share, 1, self._declaration.even, self._declaration.reach, self._declaration.decay)

    def _launch(self, kernel: wp.Kernel, dim: int | tuple[int, ...], *numbers: float) -> None:
        wp.launch(kernel, dim=dim, inputs=[*numbers, self.arrays, self._sums], device=self._device)
