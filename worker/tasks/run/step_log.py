"""What a task may log of each control step of a training."""

from __future__ import annotations

from typing import Any, Protocol


class StepLog(Protocol):
    """Of the main rank. The first three methods belong to the training's thread and wait for nothing, the others to one that may wait."""

    def begin(self) -> None:
        """An iteration begins."""

    def copy(self) -> None:
        """Have the device send what it noted in the iteration."""

    def taken(self) -> Any:
        """What was sent, once the host has waited for the iteration."""

    def write(self, iteration: int, taken: Any) -> None:
        """Write what was :meth:`taken` of an iteration, from 0 on. Raises OSError."""

    def keep(self, iteration: int) -> None:
        """Keep what a run that goes on from the checkpoint after ``iteration`` iterations needs. Raises OSError."""
