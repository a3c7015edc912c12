"""What an algorithm is to the rest of Muster: the loop, checkpoints, evaluation, the memory estimate and export know only this.

An iteration calls, in this order: :meth:`Algorithm.begin`; then, ``steps`` times, :meth:`Algorithm.act`, the task's step and
:meth:`Algorithm.record`; then :meth:`Algorithm.learn`. On CUDA the steps of an iteration become one graph where the algorithm allows
it, and :meth:`Algorithm.learn` may replay graphs of its own (:class:`worker.learning.cuda_graph.CudaGraphFunction`).
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol, runtime_checkable

import torch
from tensordict import TensorDict
from torch import nn

from worker.distributed import Gang
from worker.learning.cuda_graph import CudaGraphFunction

POLICY = "policy"
"""Name of the observation group that every task has: what the policy sees."""


@dataclass(frozen=True)
class Share:
    """Which worlds a rank holds: ``[first, first + count)`` of ``total``, by global index."""

    first: int
    count: int
    total: int

    @classmethod
    def of(cls, rank: int, ranks: int, total: int) -> Share:
        """Rank r of R holds worlds ``[r·T // R, (r + 1)·T // R)`` of T."""
        first = rank * total // ranks
        return cls(first, (rank + 1) * total // ranks - first, total)


@dataclass(frozen=True)
class Spaces:
    """What goes into a policy and what comes out of it."""

    observations: Mapping[str, tuple[int, ...]]
    """Shape of one observation of each group: ``(size,)`` of numbers, ``(channels, height, width)`` of an image of bytes."""
    actions: int
    """Length of one action; of a task with choices, how many there are."""
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
class Setting:
    """Where an algorithm learns."""

    spaces: Spaces
    share: Share
    """The worlds of this rank, and of all."""
    gang: Gang
    """The ranks that learn together; its ``device`` is where everything is."""
    seed: int
    """Of everything that the algorithm draws. Weights are drawn from torch's own generator, which is seeded alike on all ranks."""
    control_seconds: float = 1.0
    """Length of a control step [s]."""
    rehearsal: bool = False
    """Whether one iteration is run to see what memory it takes, and nothing else: it has to learn, as if what it waits for (a full
    replay, a teacher's weights) were there."""


@dataclass(frozen=True)
class Transition:
    """What one control step of all worlds of the rank did. The tensors are the task's own buffers: copy what is kept."""

    observations: TensorDict
    """After the step, and after the reset of the worlds whose episode ended: where the next step begins. Batch size (worlds,)."""
    terminal_observations: TensorDict
    """Before that reset; valid where ``dones``, and holding vector groups alone: of images none is taken then. Batch size (worlds,)."""
    rewards: torch.Tensor
    """Shape (worlds,), float32."""
    dones: torch.Tensor
    """Whether the episode ended, for any reason; shape (worlds,), bool."""
    time_outs: torch.Tensor
    """Whether it ended by the clock alone; shape (worlds,), bool."""


class Policy(Protocol):
    """What was learnt, without anything that learning needs: it is evaluated and exported. It draws no random numbers."""

    def act(self, observations: TensorDict) -> torch.Tensor:
        """The policy's best action for each world.

        Args:
            observations: As the task gives them, batch size (n,); the groups in ``spaces.observations``.

        Returns:
            Shape (n, actions), float32; of a task with choices (n, 1).
        """

    def reset(self, worlds: torch.Tensor | None = None) -> None:
        """Forget what is remembered of the running episodes (recurrent policies), of all worlds or where ``worlds`` (n,) is true."""

    def module(self) -> ExportedPolicy:
        """The same policy as a module that can be written as ONNX, on the CPU."""

    def state_dict(self) -> Mapping[str, Any]:
        """Tensors and plain values."""

    def load_state_dict(self, state: Mapping[str, Any]) -> Any:
        """Take over what :meth:`state_dict` gave. Raises RuntimeError where it does not fit."""


@dataclass(frozen=True)
class ExportedPolicy:
    """A policy as a function of tensors."""

    network: nn.Module
    """Takes the inputs in order; gives the outputs in order: the actions, then the new recurrent state, if any."""
    inputs: Mapping[str, torch.Tensor]
    """An example of each input, batch size 1: ``obs`` (and one more for each further group), then the recurrent state, if any."""
    outputs: Sequence[str]
    """Names: ``actions``, then the recurrent state, if any, as ``<input>_out``."""
    sample: TensorDict
    """Observations as the policy has met them, batch size (n,), in the order of the inputs: those on which what was exported is
    compared."""

    @property
    def states(self) -> list[str]:
        """Names of the inputs that are the recurrent state."""
        return list(self.inputs)[len(self.sample.keys()) :]

    def named(self, observations: TensorDict) -> dict[str, torch.Tensor]:
        """Observations, with the groups of the sample in its order, by the names of the inputs."""
        return dict(zip(self.inputs, observations.values(), strict=False))


class Algorithm(Protocol):
    """Learns from the worlds of one rank, in step with the other ranks.

    Statistics, gradients and normalisers are those of the whole gang. Random numbers depend on the seed, the iteration and the global
    index of the world alone, or on torch's generators, whose states are saved for each rank.
    """

    config_type: ClassVar[Any]
    """Its settings: a pydantic dataclass that is imported without torch. ``fixed``, where it has that, names those that a resumed run
    can't change."""
    captures_rollout: ClassVar[bool]
    """Whether :meth:`act` and :meth:`record` keep to the rules of :class:`worker.learning.cuda_graph.CudaGraphFunction`.

    One more attribute of the class is optional: ``kernels``, modules with Warp kernels, which one rank of each host compiles."""

    steps: int
    """Control steps of every world in one iteration."""
    graphs: Sequence[CudaGraphFunction]
    """What :meth:`learn` replays as graphs, for the run's log; the loop releases them in the end."""

    def __init__(self, config: Any, setting: Setting) -> None:
        """Allocate everything once. Raises ValueError, in one line with the name of the setting, for what it can't do."""

    def begin(self, iteration: int) -> None:
        """Called before the steps of an iteration, outside any graph: schedules, and what must be drawn beforehand.

        Args:
            iteration: How many are done.
        """

    def act(self, observations: TensorDict) -> torch.Tensor:
        """Actions to take now, shape (worlds, actions), float32; of a task with choices (worlds, 1). Batch size (worlds,)."""

    def record(self, step: Transition) -> None:
        """Take in what the step after :meth:`act` did."""

    def learn(self, observations: TensorDict) -> Mapping[str, torch.Tensor]:
        """Learn from what was recorded; nothing in here waits for the device.

        Args:
            observations: After the last step, batch size (worlds,).

        Returns:
            Metrics of all ranks by name, each of shape (), on the device: the same names in every iteration, the same values on all
            ranks, and finite: where one is not, training ends with an error that names it. A ``learning_rate`` is kept in manifests.
        """

    def policy(self) -> Policy:
        """What was learnt so far: a live view, which changes as learning goes on."""

    def state_dict(self) -> Mapping[str, Any]:
        """All that outlasts an iteration and is the same on all ranks (live tensors and plain values), with the policy under ``policy``."""

    def load_state_dict(
        self, state: Mapping[str, Any], *, weights_only: bool = False, changed: Collection[str] = ()
    ) -> Sequence[str]:
        """Go on from :meth:`state_dict`.

        Args:
            weights_only: From its networks and normalisers alone, with a fresh optimizer.
            changed: Settings that this job gives otherwise than the one before it, so that they count, not what was saved.

        Returns:
            Lines for the log: what was set in place of what was saved.

        Raises:
            RuntimeError, ValueError, KeyError: It does not fit.
        """

    def world_state(self) -> Mapping[str, torch.Tensor]:
        """What is kept for each world from iteration to iteration (recurrent state, replay): live, leading dimension (worlds,)."""

    def load_world_state(self, state: Mapping[str, torch.Tensor]) -> None:
        """Go on from :meth:`world_state`, of the same worlds in the same order."""

    @classmethod
    def build_policy(cls, config: Any, spaces: Spaces, device: str) -> Policy:
        """A policy that can take over the ``policy`` of a :meth:`state_dict`, without anything that learning needs."""


@runtime_checkable
class Student(Protocol):
    """What an :class:`Algorithm` has besides, where it may learn from the policy of another run."""

    teacher_checkpoint: str | None
    """That run, ``RUN`` or ``RUN@ITERATION``; None where these settings ask for no teacher. The setting has the same name."""

    def load_teacher(self, state: Mapping[str, Any]) -> None:
        """Take the teacher's weights from its :meth:`Algorithm.state_dict`; called on all ranks before the first iteration of a run.

        A run that goes on has them in its own checkpoint. Raises ValueError where they do not fit.
        """
