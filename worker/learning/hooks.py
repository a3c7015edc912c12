"""Hooks of a training: what watches it, and what follows its end. The loop knows nothing else of either."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from worker.learning.loop import Loop


class Hook:
    """Does nothing; a subclass overrides what it needs. All ranks call each method, on the training's thread."""

    def begin(self, loop: Loop) -> None:
        """Before the first iteration of this process."""

    def before_iteration(self) -> bool:
        """Between two iterations; returns whether the hook changed something inside the rollout, which is then captured anew."""
        return False

    def trained(self, loop: Loop, checkpoint: str) -> None:
        """After the last iteration: ``checkpoint``, the name of its checkpoint, is durable. Not called for a training that is stopped."""

    def close(self) -> None:
        """The training is over, however it ended; also called where :meth:`begin` was not."""
