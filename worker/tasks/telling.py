"""A task's report on its metrics and on functions of the user, such as a learner's reward: where they run, and their errors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence


class Telling:
    """A task that shows no metric and has no function of the user; others override this."""

    final_metrics: tuple[str, ...] = ()
    """Metrics whose value at an episode's last step counts."""
    shown_metrics: Mapping[str, str] = {}
    """Metrics that a training's progress shows, and their units."""

    waits_for_host: bool = False
    """Whether a step reads data back to the host, so that no graph can hold it."""

    def notes(self) -> Sequence[str]:
        """Lines about them, for the start of a training's log."""
        return ()

    def failures(self) -> Mapping[str, tuple[int, int]]:
        """Errors in them since the task was built; waits for the device.

        Returns:
            By error line: its count, and the first world, counted over all ranks; the most frequent first.
        """
        return {}
