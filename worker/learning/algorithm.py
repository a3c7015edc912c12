"""The algorithm protocol: all that the loop, checkpoints, evaluation, the memory estimate and export know of an algorithm.

An iteration calls, in this order: :meth:`Algorithm.begin`; then, ``steps`` times, :meth:`Algorithm.act`, the task's step and
:meth:`Algorithm.record`; then :meth:`Algorithm.learn`. On CUDA the steps of an iteration become one graph if the algorithm allows
it, and :meth:`Algorithm.learn` may replay graphs of its own (:class:`worker.learning.cuda_graph.CudaGraphFunction`).
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol, runtime_checkable

import torch
from tensordict import TensorDict
from torch import nn

from worker.learning.cuda_graph import CudaGraphFunction
from worker.learning.distributed import Gang

POLICY = "policy"
"""Name of the observation group that every task has: the policy's observations."""


@dataclass(frozen=True)
class WorldShare:
    """The worlds of a rank: ``[first, first + count)`` of ``total``, by global index."""

    first: int
    count: int
    total: int

    @classmethod
    def of(cls, rank: int, ranks: int, total: int) -> WorldShare:
        """Rank r of R holds worlds ``[r·T // R, (r + 1)·T // R)`` of T."""
        first = rank * total // ranks
        return cls(first, (rank + 1) * total // ranks - first, total)


@dataclass(frozen=True)
class Spaces:
    """Shapes of a policy's inputs and outputs."""

    observations: Mapping[str, tuple[int, ...]]
    """Shape of one observation of each group: ``(size,)`` of numbers, ``(channels, height, width)`` of an image of bytes."""
    actions: int
    """Length of one action; for a task with discrete actions, the number of choices."""
    discrete: bool = False
    """Whether an action is one of ``actions`` choices: then :meth:`Algorithm.act` returns their numbers, shape (worlds, 1), float32."""

    def example(self, worlds: int, device: str) -> TensorDict:
        """Zeros in the form of the task's observations: each group of shape (worlds, *shape), float32, images uint8."""
        groups = {
            name: torch.zeros(worlds, *shape, device=device, dtype=torch.float32 if len(shape) == 1 else torch.uint8)
            for name, shape in self.observations.items()
        }
        return TensorDict(groups, batch_size=[worlds], device=device)


@dataclass(frozen=True)
class LearningSetting:
    """The setting in which an algorithm learns."""

    spaces: Spaces
    share: WorldShare
    """The worlds of this rank, and of all."""
    gang: Gang
    """The ranks that learn together; all tensors are on its ``device``."""
    seed: int
    """Seed of all random numbers of the algorithm. Weights come from torch's own generator, which has the same seed on all ranks."""
    control_seconds: float = 1.0
    """Length of a control step [s]."""
    action_ranges: Sequence[tuple[float, float] | None] = ()
    """Range of each number of an action, beyond which the task clips it; None: it has no range. Empty: the task does not say."""
    rehearsal: bool = False
    """Whether the only purpose is to measure the memory of one iteration: it must learn as if its preconditions (a full replay, a
    teacher's weights) were met."""


@dataclass(frozen=True)
class Transition:
    """The result of one control step of all worlds of the rank. The tensors are the task's own buffers: copy those that you keep."""

    observations: TensorDict
    """Observations after the step, and after the reset of the worlds whose episode ended: the input of the next step. Batch size
    (worlds,)."""
    terminal_observations: TensorDict
    """Observations before that reset; valid where ``dones``, and only vector groups: no image is rendered then. Batch size (worlds,)."""
    rewards: torch.Tensor
    """Shape (worlds,), float32."""
    dones: torch.Tensor
    """Whether the episode ended, for any reason; shape (worlds,), bool."""
    time_outs: torch.Tensor
    """Whether it ended by the clock alone; shape (worlds,), bool."""


class Acting(Protocol):
    """A policy, as far as it is evaluated. It draws no random numbers."""

    def act(self, observations: TensorDict) -> torch.Tensor:
        """The policy's best action for each world.

        Args:
            observations: From the task, batch size (n,); the groups in ``spaces.observations``.

        Returns:
            Shape (n, actions), float32; for a task with choices (n, 1).
        """

    def reset(self, worlds: torch.Tensor | None = None) -> None:
        """Clear the recurrent state, if any, of all worlds or where ``worlds`` (n,) is true."""


class Policy(Acting, Protocol):
    """The learnt policy, without the training state, for evaluation and export."""

    def module(self) -> ExportedPolicy:
        """The same policy as a module for the export to ONNX, on the CPU."""

    def state_dict(self) -> Mapping[str, Any]:
        """Tensors and plain values."""

    def load_state_dict(self, state: Mapping[str, Any]) -> Any:
        """Load the result of :meth:`state_dict`. Raises RuntimeError if it does not fit."""


@dataclass(frozen=True)
class ExportedPolicy:
    """A policy as a function of tensors."""

    network: nn.Module
    """Takes the inputs in order; returns the outputs in order: the actions, then the new recurrent state, if any."""
    inputs: Mapping[str, torch.Tensor]
    """An example of each input, batch size 1: ``obs`` (and one more for each further group), then the recurrent state, if any."""
    outputs: Sequence[str]
    """Names: ``actions``, then the recurrent state, if any, as ``<input>_out``."""
    sample: TensorDict
    """Observations typical of the policy's training, batch size (n,), in the order of the inputs, to compare the exported policy on."""

    @property
    def states(self) -> list[str]:
        """Names of the inputs that are the recurrent state."""
        return list(self.inputs)[len(self.sample.keys()) :]

    def named(self, observations: TensorDict) -> dict[str, torch.Tensor]:
        """Observations, with the groups of the sample in its order, by the names of the inputs."""
        groups: Iterable[Any] = observations.values()
        return dict(zip(self.inputs, groups, strict=False))


class Algorithm(Protocol):
    """Learns from the worlds of one rank, in step with the other ranks.

    Statistics, gradients and normalisers are those of the whole gang. Random numbers depend on the seed, the iteration and the global
    index of the world alone, or on torch's generators, whose states are saved for each rank.
    """

    config_type: ClassVar[Any]
    """Its settings: a pydantic dataclass that is imported without torch. The optional ``fixed`` names those that a resumed run can't
    change."""
    captures_rollout: ClassVar[bool]
    """Whether :meth:`act` and :meth:`record` follow the rules of :class:`worker.learning.cuda_graph.CudaGraphFunction`.

    The class may also have an attribute ``kernels``: modules with Warp kernels, which one rank of each host compiles."""

    steps: int
    """Control steps of every world in one iteration."""
    graphs: Sequence[CudaGraphFunction]
    """The graphs that :meth:`learn` replays, for the run's log; the loop releases them at the end."""

    def __init__(self, config: Any, setting: LearningSetting) -> None:
        """Allocate all buffers once. Raises ValueError for an unsupported setting, in one line with its name."""

    def begin(self, iteration: int) -> None:
        """Called before the steps of an iteration, outside any graph: for schedules, and random numbers that must be drawn beforehand.

        Args:
            iteration: Number of finished iterations.
        """

    def act(self, observations: TensorDict) -> torch.Tensor:
        """The next actions, shape (worlds, actions), float32; for a task with choices (worlds, 1). Batch size (worlds,)."""

    def record(self, step: Transition) -> None:
        """Record the result of the step after :meth:`act`."""

    def learn(self, observations: TensorDict) -> Mapping[str, torch.Tensor]:
        """Learn from the recorded steps, without waiting for the device.

        Args:
            observations: After the last step, batch size (worlds,).

        Returns:
            Metrics of all ranks by name, each of shape (), on the device, with the same names in every iteration and the same values on
            all ranks. A non-finite value ends training with an error that names it. A ``learning_rate`` is kept in manifests.
        """

    def policy(self) -> Policy:
        """The current policy: a live view, which changes with the learning."""

    def state_dict(self) -> Mapping[str, Any]:
        """The state that outlasts an iteration and is the same on all ranks (live tensors and plain values); its key ``policy`` has the policy."""

    def load_state_dict(
        self, state: Mapping[str, Any], *, weights_only: bool = False, changed: Collection[str] = ()
    ) -> Sequence[str]:
        """Continue from :meth:`state_dict`.

        Args:
            weights_only: Load only networks and normalisers, with a new optimizer.
            changed: Settings that this job changes, whose new values override the saved ones.

        Returns:
            Lines for the log about overridden values.

        Raises:
            RuntimeError, ValueError, KeyError: It does not fit.
        """

    def world_state(self) -> Mapping[str, torch.Tensor]:
        """The state of each world between iterations (recurrent state, replay): live tensors, leading dimension (worlds,)."""

    def load_world_state(self, state: Mapping[str, torch.Tensor]) -> None:
        """Continue from :meth:`world_state` of the same worlds in the same order."""

    @classmethod
    def build_policy(cls, config: Any, spaces: Spaces, device: str) -> Policy:
        """A policy without the training state, which can load the ``policy`` of a :meth:`state_dict`."""


@runtime_checkable
class Student(Protocol):
    """Additional members of an :class:`Algorithm` that can learn from the policy of another run."""

    teacher_checkpoint: str | None
    """That run, ``RUN`` or ``RUN@ITERATION``; None without a teacher. The setting has the same name."""

    def load_teacher(self, state: Mapping[str, Any]) -> None:
        """Take the teacher's weights from its :meth:`Algorithm.state_dict`; called on all ranks before the first iteration of a run.

        A resumed run has them in its own checkpoint. Raises ValueError if they do not fit.
        """
