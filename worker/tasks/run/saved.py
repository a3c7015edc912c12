"""Check that a saved state of worlds fits a task."""

from __future__ import annotations

from collections.abc import Mapping

import torch

NEWER = ("broken", "last_actions", "earlier_actions", "activations")
"""Tensors that states of older versions lack; they may begin at 0."""


def completed(
    tensors: Mapping[str, torch.Tensor], state: Mapping[str, torch.Tensor], metrics: int
) -> dict[str, torch.Tensor]:
    """A state with zeros for tensors that an older version did not save: :data:`NEWER`, and the sums of all ``metrics``, the last ones.

    Args:
        tensors: Of the task.
        state: As saved.
        metrics: How many the task has.
    """
    found = {name: torch.zeros_like(tensors[name], device="cpu") for name in NEWER if name in tensors} | {**state}
    sums, wanted = found.get("episode_sums"), tensors["episode_sums"].shape[1]
    if sums is not None and sums.dim() == 2 and metrics and sums.shape[1] == wanted - metrics:
        found["episode_sums"] = torch.nn.functional.pad(sums, (0, metrics))
    return found


def check_state(what: str, tensors: Mapping[str, torch.Tensor], state: Mapping[str, torch.Tensor]) -> None:
    """Check a saved state against the tensors that it will fill.

    Args:
        what: The state, for the error.
        tensors: Of the task.
        state: As saved.

    Raises:
        ValueError: A tensor is missing, unknown, or of another shape or type, or the worlds' physics was drawn differently.
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
        if name == "world_factors" and not torch.equal(saved, tensor.cpu()):
            raise ValueError(
                f"{what} does not fit: its worlds have other physics; use the same seed, first world and randomize"
            )
