"""Failures of a user's functions, such as a learner's reward, as lines of the log."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from shared_store.contract.error_text import counted

if TYPE_CHECKING:
    from worker.tasks.run.task_report import TaskReport

MOST = 10
"""Lines at once."""


class Failures:
    """Reports each failure once, and all of them at the end. Every rank reports its own.

    Args:
        task: The task with the functions.
        say: Writes a line to the log.
    """

    def __init__(self, task: TaskReport, say: Callable[[str], None]) -> None:
        self._task, self._say = task, say
        self._known: set[str] = set()

    def tell(self, *, again: bool = False) -> None:
        """Report new failures, or all of them if ``again``; waits for the device."""
        found = [item for item in self._task.failures().items() if again or item[0] not in self._known]
        for told, (count, world) in found[:MOST]:
            self._known.add(told)
            self._say(f"warning: {told} ({counted(count, 'call')} so far, first in world {world})")
