"""What a task tells of its metrics, and of functions that it was given, such as a learner's reward: where they run, and what failed in them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence


class Telling:
    """A task that shows no metric and was given no function; others override this."""

    final_metrics: tuple[str, ...] = ()
    """Metrics of which an episode's last step counts."""
    shown_metrics: Mapping[str, str] = {}
    """Metrics that a training's progress shows, and their units."""

    waits_for_host: bool = False
    """Whether a step reads anything back to the host: then no graph can hold it."""

    def notes(self) -> Sequence[str]:
        """What the log of a training says of them once, a line each."""
        return ()

    def failures(self) -> Mapping[str, tuple[int, int]]:
        """What went wrong in them since the task was built; waits for the device.

        Returns:
            By a line that says what: how often, and in which world first, counted over all ranks; the most frequent first.
        """
        return {}
