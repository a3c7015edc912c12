"""The newest steps of every world of a rank, on the device."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch

from worker.learning.sac import kernels


@dataclass(frozen=True)
class Batch:
    """Sampled transitions of n steps, or of fewer where the episode ended before. First dimension (samples,)."""

    before: torch.Tensor
    """Observations and action at the beginning, shape (samples, observations + actions), float32."""
    after: torch.Tensor
    """Observations in which it ended, shape (samples, observations), float32."""
    returns: torch.Tensor
    """Discounted sum of the rewards, shape (samples,), float32."""
    discounts: torch.Tensor
    """Worth of what comes after: γ to the number of steps; 0 where nothing does. Shape (samples,), float32."""


class Replay:
    """A ring of (capacity steps, worlds), allocated once.

    It holds, of each step of each world, the observations before it and the action (``before``), the observations after it (``after``:
    those before the reset where the episode ended), and three numbers (``outcomes``): the reward, whether the episode went on, and
    whether anything comes after. The observations after a step are stored although most are those before the next one: sampling is two
    gathers of whole rows then, and nothing depends on which steps ended an episode. That costs
    4 · (2 · observations + actions + 3) bytes a sample: 356 for 39 observations and 8 actions, 1.5 GB for 1024 steps of 4096 worlds.

    Only beginnings from which n steps are there are drawn, so no transition reaches over the newest step to the oldest ones.

    Args:
        capacity: Steps of each world.
        worlds: Of this rank.
        observations: Length of what is observed.
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
        """Steps of each world that were ever written."""
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
        """Write one step of all worlds, over the oldest one where the ring is full.

        Args:
            slot: Where, shape (1,), int64, on the device: a graph writes elsewhere in each iteration.
            before: Shape (worlds, observations + actions), float32.
            after: Shape (worlds, observations), float32.
            outcomes: Reward, whether the episode went on, whether anything comes after; shape (worlds, 3), float32.
        """
        for ring, rows in ((self.before, before), (self.after, after), (self.outcomes, outcomes)):
            ring.index_copy_(0, slot, rows.unsqueeze(0))

    def advance(self, steps: int) -> None:
        """So many steps were written."""
        self.recorded += steps
        self._recorded.fill_(self.recorded)

    def clear(self) -> None:
        """Forget everything."""
        self.advance(-self.recorded)

    def draw(self, rows: torch.Tensor, generator: torch.Generator, steps: int = 0) -> bool:
        """Draw which transitions to learn from, once ``steps`` more are written.

        Args:
            rows: Filled with rows of the ring as :meth:`sample` takes them; any shape, int64. Left alone where there is no transition.
            generator: On the rows' device.
            steps: How many steps are going to be written before the rows are read.

        Returns:
            Whether there is any.
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
        last, returns, discounts = torch.empty_like(rows), *self._powers.new_empty(2, len(rows)).unbind()
        kernels.look_ahead(rows, self.outcomes.flatten(0, 1), self.worlds, self._powers, last, returns, discounts)
        before, after = self.before.flatten(0, 1)[rows], self.after.flatten(0, 1)[last]
        return Batch(before, after, returns, discounts)

    def newest(self, slots: torch.Tensor) -> torch.Tensor:
        """What was seen in ``slots``, shape (steps,), int64: shape (steps, worlds, observations + actions)."""
        return self.before[slots]

    def world_state(self) -> dict[str, torch.Tensor]:
        """Live views of all that was written, leading dimension (worlds,)."""
        return {"recorded": self._recorded, **self._written(self.recorded)}

    def _written(self, recorded: int) -> dict[str, torch.Tensor]:
        """The places that hold something after ``recorded`` steps, shape (worlds, places, …): the ring fills from its beginning."""
        rings = {"before": self.before, "after": self.after, "outcomes": self.outcomes}
        return {name: ring[: min(recorded, self.capacity)].transpose(0, 1) for name, ring in rings.items()}

    def load_world_state(self, state: Mapping[str, torch.Tensor]) -> None:
        """Go on from :meth:`world_state`. Raises ValueError where it is that of another ring, and KeyError where it lacks something."""
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
