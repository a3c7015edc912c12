"""The replay buffer: the newest steps of every world of a rank, on the device."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch

from worker.learning.sac import kernels


@dataclass(frozen=True)
class Batch:
    """Sampled transitions of n steps, or of fewer if the episode ended earlier. First dimension (samples,)."""

    before: torch.Tensor
    """Observations and action at the beginning, shape (samples, observations + actions), float32."""
    after: torch.Tensor
    """Observations at the end, shape (samples, observations), float32."""
    returns: torch.Tensor
    """Discounted sum of the rewards, shape (samples,), float32."""
    discounts: torch.Tensor
    """Discount of the future: γ to the number of steps; 0 without a future. Shape (samples,), float32."""


class ReplayBuffer:
    """A ring of (capacity steps, worlds), allocated once.

    For each step of each world it holds the observations before it and the action (``before``), the observations after it (``after``:
    before the reset, if the episode ended), and three numbers (``outcomes``): the reward, whether the episode continued, and whether a
    future follows. Most observations after a step equal those before the next one, but with both, sampling is two gathers of whole rows,
    wherever episodes end. That costs 4 · (2 · observations + actions + 3) bytes per sample: 356 for 39 observations and 8 actions, 1.5 GB
    for 1024 steps of 4096 worlds.

    Only steps with n steps after them are drawn as beginnings, so no transition wraps from the newest step to the oldest.

    Args:
        capacity: Steps of each world.
        worlds: Worlds of this rank.
        observations: Length of one observation.
        actions: Length of an action.
        n_step: Steps of a transition, at most ``capacity``.
        gamma: Discount of a step.
        device: ``"cpu"`` or ``"cuda:<n>"``.
    """

    def __init__(
        self, capacity: int, worlds: int, observations: int, actions: int, n_step: int, gamma: float, device: str
    ) -> None:
        self.capacity, self.worlds, self.n_step = capacity, worlds, n_step
        self.before = torch.zeros(capacity, worlds, observations + actions, device=device)
        self.after = torch.zeros(capacity, worlds, observations, device=device)
        self.outcomes = torch.zeros(capacity, worlds, 3, device=device)
        self.recorded = 0
        """Number of steps of each world written so far."""
        self._recorded = torch.zeros(worlds, dtype=torch.int64, device=device)  # the same, saved with the worlds
        self._powers = torch.tensor([gamma**k for k in range(n_step + 1)], device=device)

    @property
    def nbytes(self) -> int:
        """Memory of the ring [bytes]."""
        return self.before.nbytes + self.after.nbytes + self.outcomes.nbytes

    def find_slots(self, slots: torch.Tensor) -> None:
        """Fill ``slots``, shape (n,), int64, with the places of the next n steps."""
        torch.arange(len(slots), out=slots).add_(self.recorded).remainder_(self.capacity)

    def write(self, slot: torch.Tensor, before: torch.Tensor, after: torch.Tensor, outcomes: torch.Tensor) -> None:
        """Write one step of all worlds, over the oldest one if the ring is full.

        Args:
            slot: Place of the step, shape (1,), int64, on the device, since a graph writes to another place in each iteration.
            before: Shape (worlds, observations + actions), float32.
            after: Shape (worlds, observations), float32.
            outcomes: Reward, whether the episode continued, whether a future follows; shape (worlds, 3), float32.
        """
        for ring, rows in ((self.before, before), (self.after, after), (self.outcomes, outcomes)):
            ring.index_copy_(0, slot, rows.unsqueeze(0))

    def advance(self, steps: int) -> None:
        """Count ``steps`` more written steps."""
        self.recorded += steps
        self._recorded.fill_(self.recorded)

    def draw(self, rows: torch.Tensor, generator: torch.Generator, steps: int = 0) -> bool:
        """Draw the transitions to learn from after ``steps`` more steps are written.

        Args:
            rows: Filled with rows of the ring for :meth:`sample`; any shape, int64. Unchanged without any transition.
            generator: A generator on the rows' device.
            steps: Number of steps that will be written before the rows are read.

        Returns:
            Whether there is any transition.
        """
        recorded = self.recorded + steps
        filled = min(recorded, self.capacity)
        beginnings = filled - self.n_step + 1
        if beginnings < 1:
            return False
        rows.random_(0, beginnings * self.worlds, generator=generator)
        rows.add_((recorded - filled) % self.capacity * self.worlds).remainder_(self.capacity * self.worlds)
        return True

    def sample(self, rows: torch.Tensor) -> Batch:
        """The transitions that begin in ``rows``, shape (samples,), int64."""
        last, returns, discounts = kernels.look_ahead(rows, self.outcomes.flatten(0, 1), self.worlds, self._powers)
        before, after = self.before.flatten(0, 1)[rows], self.after.flatten(0, 1)[last]
        return Batch(before, after, returns, discounts)

    def world_state(self) -> dict[str, torch.Tensor]:
        """Live views of all written steps, leading dimension (worlds,)."""
        return {"recorded": self._recorded, **self._written(self.recorded)}

    def _written(self, recorded: int) -> dict[str, torch.Tensor]:
        """The filled places after ``recorded`` steps, shape (worlds, places, …): the ring fills from its beginning."""
        rings = {"before": self.before, "after": self.after, "outcomes": self.outcomes}
        return {name: ring[: min(recorded, self.capacity)].transpose(0, 1) for name, ring in rings.items()}

    def load_world_state(self, state: Mapping[str, torch.Tensor]) -> None:
        """Continue from :meth:`world_state`. Raises ValueError if it belongs to another ring, and KeyError if something is missing."""
        live = {"recorded": self._recorded, **self._written(int(state["recorded"][0]))}
        for name, tensor in live.items():
            if state[name].shape != tensor.shape:
                raise ValueError(
                    f"the saved replay does not fit: {name} is {tuple(state[name].shape)}, expected {tuple(tensor.shape)}; "
                    "sac.replay_steps, the observations and the actions must be as they were"
                )
        for name, tensor in live.items():
            tensor.copy_(state[name])
        self.recorded = int(self._recorded[0])
