"""Check that a saved state of worlds fits a task."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch

from worker.settings.task import FACTORS
from worker.tasks.compile.configured import FACTOR

NEWER = ("broken", "last_actions", "earlier_actions", "activations")
"""Tensors that states of older versions lack; they may begin at 0."""
RENAMED = {"images": "sensor_camera_images"}
"""Tensors of older versions and their names by now."""


def completed(
    tensors: Mapping[str, torch.Tensor], state: Mapping[str, torch.Tensor], metrics: int, drawn: Sequence[str]
) -> dict[str, torch.Tensor]:
    """A state in the form of this version.

    One of an older version lacks :data:`NEWER` and the sums of the metrics, which are the last ones, and has the factors of
    ``config.randomize`` apart from the other draws.

    Args:
        tensors: Of the task.
        state: As saved.
        metrics: How many the task has.
        drawn: Names of the columns of its draws.
    """
    found = {name: torch.zeros_like(tensors[name], device="cpu") for name in NEWER if name in tensors} | {**state}
    for old, new in RENAMED.items():
        if new in tensors and old in found:
            found[new] = found.pop(old)
    sums, columns = found.get("episode_sums"), tensors["episode_sums"].shape[1]
    if sums is not None and sums.dim() == 2 and metrics and sums.shape[1] == columns - metrics:
        found["episode_sums"] = torch.nn.functional.pad(sums, (0, metrics))
    factors = found.pop("world_factors", None)
    if factors is not None and "randomization_draws" in tensors:
        for name in ("randomization_draws", "randomization_countdowns"):
            now = tensors[name].cpu().clone()
            if name in found:  # those of the task's own entries come first
                now[:, : found[name].shape[1]] = found[name]
            found[name] = now
        for factor, values in zip(FACTORS, factors.unbind(1), strict=True):
            for column, name in enumerate(drawn):
                if name.partition("/")[0] == FACTOR.format(factor):
                    found["randomization_draws"][:, column] = values
    return found


def check_state(what: str, tensors: Mapping[str, torch.Tensor], state: Mapping[str, torch.Tensor]) -> None:
    """Check a saved state against the tensors that it will fill.

    Args:
        what: The state, for the error.
        tensors: Of the task.
        state: As saved.

    Raises:
        ValueError: A tensor is missing, unknown, or of another shape or type.
    """
    if missing := sorted(tensors.keys() - state.keys()):
        raise ValueError(f"{what} lacks {', '.join(missing)}")
    if unknown := sorted(state.keys() - tensors.keys()):
        raise ValueError(f"{what} holds {', '.join(unknown)}, which the task does not have")
    for name, tensor in tensors.items():
        saved = state[name]
        if saved.shape != tensor.shape or saved.dtype != tensor.dtype:
            raise ValueError(
                f"{what} does not fit: {name} is {tuple(saved.shape)} {saved.dtype}, "
                f"expected {tuple(tensor.shape)} {tensor.dtype}"
            )
