"""Hooks of a training: what watches it, and what follows its end. The loop knows nothing else of either."""

from __future__ import annotations

import os
import signal
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from worker.settings.errors import UserError

if TYPE_CHECKING:
    from worker.learning.job import Job
    from worker.learning.loop import Loop


class Hook:
    """Does nothing; a subclass overrides what it needs. All ranks call each method, on the training's thread."""

    def begin(self, loop: Loop) -> None:
        """Before the first iteration of this process."""

    def before_iteration(self) -> bool:
        """Between two iterations; returns whether the hook changed something inside the rollout, which is then captured anew."""
        return False

    def iteration(self, record: dict[str, Any]) -> None:
        """After an iteration, with its record; the same on all ranks."""

    def trained(self, loop: Loop, checkpoint: str) -> None:
        """After the last iteration: ``checkpoint``, the name of its checkpoint, is durable. Not called for a training that is stopped."""

    def close(self) -> None:
        """The training is over, however it ended; also called where :meth:`begin` was not."""


class FaultInjection(Hook):
    """Proves that a run survives a crash.

    ``MUSTER_KILL_AT=N`` in a training job's environment: in the job's first attempt the main rank kills itself with SIGKILL right after the
    gang has finished iteration N, before any of it is written: no metrics, no checkpoint. ``muster verify-resume`` sets it, and a job from
    the Batch API may.
    """

    def __init__(self, env: Mapping[str, str], job: Job) -> None:
        """Raises UserError for a value other than an iteration."""
        text = env.get("MUSTER_KILL_AT")
        if text and not (text.isdecimal() and int(text) >= 1):
            raise UserError(f"MUSTER_KILL_AT is {text!r}; set it to the number of an iteration, from 1")
        self._iteration = int(text) if text and job.epoch == job.job_epoch else None

    def iteration(self, record: dict[str, Any]) -> None:
        if record["iteration"] == self._iteration:
            os.kill(os.getpid(), signal.SIGKILL)  # like a crash: no handler runs, nothing is flushed
